"""Speed, compile time and exactness of the physics engines, side by side in one run.

    taskset -c 0 python benchmarks/physics.py

For each task: environment steps per second of each engine under random actions, over those of C MuJoCo on one thread; and
the error of one environment step in each engine against Gymnasium's v4 task from the same state, over states visited by
random and held actions and by the policies of `--runs` (run directories of experiments/train.py). On a CPU seconds are
those that the process used, so keep it on one core. With `--device gpu` the engines in JAX are measured on the GPU, by the
clock, and nothing else should run on the machine meanwhile.
"""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from mujoco.batch import Batch

import dgae_jax as dg
from dgae_jax.cli import parse
from dgae_jax.envs.registry import TASKS
from dgae_jax.learn import devices
from dgae_jax.learn.parallel import COMPILER_OPTIONS
from dgae_jax.physics.registry import ENGINES
from dgae_jax.run import directory


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """Tasks."""
    engines: tuple[str, ...] = tuple(ENGINES)
    """Engines; mjx takes up to a minute to compile per task and batch size."""
    worlds: tuple[int, ...] = (64, 512, 2048)
    """Batch sizes [worlds]; none to leave speeds out."""
    seconds: float = 1.0
    """Length of a measurement [s]; the fastest of three counts."""
    states: int = 1000
    """States to compare at, per source [states]; 0 to leave exactness out."""
    runs: tuple[Path, ...] = ()
    """Run directories whose policies visit states too."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Device of the engines in JAX."""
    x64: bool = False
    """Compute in float64; mjx-warp stays in float32."""
    devices: int = 1
    """Devices that divide the worlds of engines in JAX, of a CPU its cores; then speeds are by the clock [devices]."""

    def clock(self) -> float:
        """On a CPU the seconds that this process used, which on one core other programs disturb least."""
        return (
            time.process_time()
            if self.device == "cpu" and self.devices == 1
            else time.perf_counter()
        )


def steps_per_second(run: Callable[[int], Any], worlds: int, arguments: Arguments) -> float:
    """Environment steps per second of `run(count)`, which steps all worlds `count` times."""

    def timed(count: int) -> float:
        since = arguments.clock()
        run(count)
        return arguments.clock() - since

    timed(1)
    count = max(1, int(arguments.seconds / timed(1)))
    return worlds * count / min(timed(count) for _ in range(3))


def c_speed(name: str, worlds: int, arguments: Arguments) -> float:
    """C MuJoCo on one thread, under new random controls at every step."""
    env: Any = dg.make_env(name, physics="native")
    model, rng = env.physics.model, np.random.default_rng(0)
    batch = Batch(model, worlds, 1)
    batch.bind("qpos")[:] = model.qpos0

    def run(count: int) -> None:
        for _ in range(count):
            batch.bind("ctrl")[:] = rng.uniform(-1, 1, (worlds, model.nu))
            batch.step(nstep=env.FRAME_SKIP)

    return steps_per_second(run, worlds, arguments)


def engine_speed(name: str, engine: str, worlds: int, arguments: Arguments) -> tuple[float, float]:
    """Environment steps per second of an engine, and seconds to compile."""
    env: Any = dg.make_env(name, physics=engine)
    physics = env.physics

    def some(state, key, count):
        def one(i, state):
            ctrl = jax.random.uniform(
                jax.random.fold_in(key, i), (len(state.qpos), physics.model.nu), minval=-1, maxval=1
            )
            return jax.vmap(physics.step)(state, ctrl)

        return jax.lax.fori_loop(0, count, one, state)

    @partial(jax.jit, compiler_options=COMPILER_OPTIONS)
    def run(state, key, count):
        with devices.shared_by(devices.make_mesh(arguments.devices)):
            return devices.divided(some, (0, None, None), 0)(state, key, count)

    qpos = jnp.broadcast_to(jnp.asarray(physics.model.qpos0), (worlds, physics.model.nq))
    state = physics.init(qpos, jnp.zeros((worlds, physics.model.nv)))
    since = arguments.clock()
    compiled = run.lower(state, jax.random.key(0), 1).compile()
    compiling = arguments.clock() - since
    return steps_per_second(
        lambda n: jax.block_until_ready(compiled(state, jax.random.key(1), n)), worlds, arguments
    ), compiling


def speeds(arguments: Arguments) -> None:
    """A row per task, batch size and engine."""
    print(f"{'task':9s} {'worlds':>6s} {'engine':9s} {'steps/s':>9s} {'/ C':>6s} {'compile s':>9s}")
    for name in arguments.tasks:
        for worlds in arguments.worlds:
            reference = c_speed(name, worlds, arguments)
            print(f"{name:9s} {worlds:6,} {'C':9s} {reference:9,.0f} {1:6.2f}", flush=True)
            for engine in arguments.engines:
                speed, compiling = engine_speed(name, engine, worlds, arguments)
                print(
                    f"{name:9s} {worlds:6,} {engine:9s} {speed:9,.0f} {speed / reference:6.2f} {compiling:9.1f}",
                    flush=True,
                )


def gymnasium_task(name: str):
    """Gymnasium's v4 task."""
    gymnasium.logger.min_level = gymnasium.logger.ERROR
    return gymnasium.make(TASKS[name].eval_envs["v4"]).unwrapped


def visited(
    name: str, count: int, act: Callable[[np.ndarray], np.ndarray] | None, dtype: type
) -> tuple[np.ndarray, ...]:
    """Poses with the action taken there: of `act`, or random and held actions, episodes of 50 steps that go on when fallen."""
    gym, rng, kept, episode = gymnasium_task(name), np.random.default_rng(0), [], 0
    while len(kept) < count:
        obs, _ = gym.reset(seed=episode)
        held, episode = rng.uniform(-1, 1, gym.action_space.shape), episode + 1
        for _ in range(50 if act is None else 200):
            action = act(obs) if act else (held if episode % 2 else rng.uniform(-1, 1, held.shape))
            action = np.asarray(action, np.float32)
            kept.append(
                (gym.data.qpos.astype(dtype), gym.data.qvel.astype(dtype), action.astype(dtype))
            )
            obs = gym.step(action)[0]
    return tuple(np.stack(x) for x in zip(*kept[:count], strict=True))


def gymnasium_steps(name: str, poses: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray, int]:
    """Observation and reward of one step of Gymnasium's task from each pose, and the most contacts seen."""
    gym, observations, rewards, contacts = gymnasium_task(name), [], [], 0
    for qpos, qvel, action in zip(*poses, strict=True):
        gym.reset()
        gym.set_state(qpos.astype(float), qvel.astype(float))
        obs, reward, *_ = gym.step(action)
        observations.append(obs)
        rewards.append(float(reward))
        contacts = max(contacts, gym.data.ncon)
    return np.stack(observations), np.array(rewards), contacts


def errors(
    name: str,
    engine: str,
    poses: tuple[np.ndarray, ...],
    observations: np.ndarray,
    rewards: np.ndarray,
) -> str:
    """Observation and reward errors of one step in an engine from each pose."""
    env = dg.make_env(name, physics=engine)

    @jax.jit
    def step(key, qpos, qvel, action):
        return jax.vmap(lambda q, v, a: env.step(env.set_state(env.reset(key), q, v), a))(
            qpos, qvel, action
        )

    after = step(jax.random.key(0), *map(jnp.asarray, poses))
    median, most, worst = np.quantile(
        np.abs(observations - np.asarray(after.obs)).max(1), (0.5, 0.99, 1)
    )
    return f"{median:9.1e} {most:9.1e} {worst:9.1e} {np.abs(rewards - np.asarray(after.reward)).max():9.1e}"


def exactness(arguments: Arguments) -> None:
    """A row per task, source of states and engine."""
    print(
        f"one step against Gymnasium, {'float64' if arguments.x64 else 'float32'}: error of the observation and the reward"
    )
    print(
        f"{'task':9s} {'states of':9s} {'engine':9s} {'median':>9s} {'99 %':>9s} {'worst':>9s} {'reward':>9s} {'contacts':>8s}"
    )
    policies = [(name, None) for name in arguments.tasks] + [
        policy_of(run) for run in arguments.runs
    ]
    for name, act in policies:
        poses = visited(name, arguments.states, act, np.float64 if arguments.x64 else np.float32)
        observations, rewards, contacts = gymnasium_steps(name, poses)
        for engine in arguments.engines:
            row = errors(name, engine, poses, observations, rewards)
            print(
                f"{name:9s} {'a policy' if act else 'random':9s} {engine:9s} {row} {contacts:8d}",
                flush=True,
            )


def policy_of(run_dir: Path) -> tuple[str, Callable[[np.ndarray], np.ndarray]]:
    """The task of a run and its mean action."""
    with jax.enable_x64(False):  # policies are float32
        policy = dg.load_policy(run_dir)

    def act(obs: np.ndarray) -> np.ndarray:
        with jax.enable_x64(False):
            return policy(obs)

    return directory.read_config(run_dir).env, act


def main() -> None:
    """Print both tables."""
    arguments = parse.arguments(
        Arguments, description="Speed and exactness of the physics engines."
    )
    jax.config.update("jax_enable_compilation_cache", False)
    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[arguments.device])
    jax.config.update("jax_enable_x64", arguments.x64)
    devices.divide_cpu(arguments.devices)
    warnings.simplefilter("ignore")
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}; environment steps per second")
    speeds(arguments)
    if arguments.states:
        exactness(arguments)


if __name__ == "__main__":
    main()
