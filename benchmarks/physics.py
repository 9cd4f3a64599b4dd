"""Speed, compile time and exactness of the physics engines, in one run.

    taskset -c 0 python benchmarks/physics.py

For each task it measures environment steps per second of each engine under random actions, over
those of C MuJoCo on one thread. It then compares one environment step with Gymnasium's v4 task from
the same state, in states visited by random and held actions and by the policies of `--runs`.

On a CPU seconds are those that the process used, so keep it on one core. With `--device gpu` the
engines in JAX are measured on the GPU, by the clock, and nothing else should run.
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
import tyro
from mujoco.batch import Batch

import dgae_jax as dg
from dgae_jax.envs.registry import TASKS
from dgae_jax.learn import devices
from dgae_jax.learn.parallel import COMPILER_OPTIONS
from dgae_jax.physics.registry import ENGINES
from dgae_jax.run import directory


@dataclass(frozen=True)
class Arguments:
    """Measurements."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """Tasks."""
    engines: tuple[str, ...] = tuple(ENGINES)
    """Engines; mjx takes up to a minute to compile per task and batch size."""
    num_envs: tuple[int, ...] = (64, 512, 2048)
    """Batch sizes [envs]; none to leave speeds out."""
    seconds: float = 1.0
    """Length of a measurement [s]; the fastest of three counts."""
    states: int = 1000
    """States to compare at, per source [states]; 0 to leave exactness out."""
    runs: tuple[Path, ...] = ()
    """Run directories; their policies visit states too."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Device of the engines in JAX."""
    x64: bool = False
    """Compute in float64; mjx-warp stays in float32."""
    devices: int = 1
    """Devices, or cores of a CPU, that divide the envs; more than one is timed by the clock."""

    def clock(self) -> float:
        """Return seconds; on one core those of this process, which others disturb least."""
        alone = self.device == "cpu" and self.devices == 1
        return time.process_time() if alone else time.perf_counter()


def steps_per_second(run: Callable[[int], Any], envs: int, arguments: Arguments) -> float:
    """Return environment steps per second of `run(count)`, which steps all envs so often."""

    def timed(count: int) -> float:
        since = arguments.clock()
        run(count)
        return arguments.clock() - since

    timed(1)
    count = max(1, int(arguments.seconds / timed(1)))
    return envs * count / min(timed(count) for _ in range(3))


def c_speed(name: str, envs: int, arguments: Arguments) -> float:
    """Return the speed of C MuJoCo on one thread, with random controls at every step."""
    env: Any = dg.make_env(name, physics="native")
    model, rng = env.physics.model, np.random.default_rng(0)
    batch = Batch(model, envs, 1)
    batch.bind("qpos")[:] = model.qpos0

    def run(count: int) -> None:
        for _ in range(count):
            batch.bind("ctrl")[:] = rng.uniform(-1, 1, (envs, model.nu))
            batch.step(nstep=env.FRAME_SKIP)

    return steps_per_second(run, envs, arguments)


def engine_speed(name: str, engine: str, envs: int, arguments: Arguments) -> tuple[float, float]:
    """Return environment steps per second of an engine, and seconds to compile."""
    env: Any = dg.make_env(name, physics=engine)
    physics = env.physics

    def some(state, key, count):
        def one(i, state):
            shape = len(state.qpos), physics.model.nu
            ctrl = jax.random.uniform(jax.random.fold_in(key, i), shape, minval=-1, maxval=1)
            return jax.vmap(physics.step)(state, ctrl)

        return jax.lax.fori_loop(0, count, one, state)

    @partial(jax.jit, compiler_options=COMPILER_OPTIONS)
    def run(state, key, count):
        with devices.shared_by(devices.make_mesh(arguments.devices)):
            return devices.divided(some, (0, None, None), 0)(state, key, count)

    qpos = jnp.broadcast_to(jnp.asarray(physics.model.qpos0), (envs, physics.model.nq))
    state = physics.init(qpos, jnp.zeros((envs, physics.model.nv)))
    since = arguments.clock()
    compiled = run.lower(state, jax.random.key(0), 1).compile()
    compiling = arguments.clock() - since

    def steps(count: int) -> None:
        jax.block_until_ready(compiled(state, jax.random.key(1), count))

    return steps_per_second(steps, envs, arguments), compiling


def speeds(arguments: Arguments) -> None:
    """Print a row per task, batch size and engine."""
    print(f"{'task':9s} {'envs':>6s} {'engine':9s} {'steps/s':>9s} {'/ C':>6s} {'compile s':>9s}")
    for name in arguments.tasks:
        for envs in arguments.num_envs:
            reference = c_speed(name, envs, arguments)
            print(f"{name:9s} {envs:6,} {'C':9s} {reference:9,.0f} {1:6.2f}", flush=True)
            for engine in arguments.engines:
                speed, compiling = engine_speed(name, engine, envs, arguments)
                ratio = f"{speed:9,.0f} {speed / reference:6.2f} {compiling:9.1f}"
                print(f"{name:9s} {envs:6,} {engine:9s} {ratio}", flush=True)


def gymnasium_task(name: str):
    """Return Gymnasium's v4 task."""
    gymnasium.logger.min_level = gymnasium.logger.ERROR
    return gymnasium.make(TASKS[name].eval_envs["v4"]).unwrapped


def visited(
    name: str, count: int, act: Callable[[np.ndarray], np.ndarray] | None, dtype: type
) -> tuple[np.ndarray, ...]:
    """Return poses and the actions taken there, by `act` or random and held ones.

    Episodes have 50 steps, also after a fall, or 200 with `act`.
    """
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
    """Return observations and rewards of one step from each pose, and the most contacts."""
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
    """Return the errors of observations and rewards of one step in an engine."""
    env = dg.make_env(name, physics=engine)

    @jax.jit
    def step(key, qpos, qvel, action):
        def one(q, v, a):
            return env.step(env.set_state(env.reset(key), q, v), a)

        return jax.vmap(one)(qpos, qvel, action)

    after = step(jax.random.key(0), *map(jnp.asarray, poses))
    error = np.abs(observations - np.asarray(after.obs)).max(1)
    columns = *np.quantile(error, (0.5, 0.99, 1)), np.abs(rewards - np.asarray(after.reward)).max()
    return " ".join(f"{column:9.1e}" for column in columns)


def exactness(arguments: Arguments) -> None:
    """Print a row per task, source of states and engine."""
    dtype = np.float64 if arguments.x64 else np.float32
    print(f"one step against Gymnasium, {dtype.__name__}: error of the observation and the reward")
    columns = "median", "99 %", "worst", "reward", "contacts"
    print(f"{'task':9s} {'states of':9s} {'engine':9s}", *(f"{name:>9s}" for name in columns))
    policies = [(name, None) for name in arguments.tasks]
    for name, act in [*policies, *map(policy_of, arguments.runs)]:
        poses = visited(name, arguments.states, act, dtype)
        observations, rewards, contacts = gymnasium_steps(name, poses)
        for engine in arguments.engines:
            row = errors(name, engine, poses, observations, rewards)
            source = "a policy" if act else "random"
            print(f"{name:9s} {source:9s} {engine:9s} {row} {contacts:9d}", flush=True)


def policy_of(run_dir: Path) -> tuple[str, Callable[[np.ndarray], np.ndarray]]:
    """Return the task of a run and its policy."""
    with jax.enable_x64(False):  # policies are float32
        policy = dg.load_policy(run_dir)

    def act(obs: np.ndarray) -> np.ndarray:
        with jax.enable_x64(False):
            return policy(obs)

    return directory.read_config(run_dir).env, act


def main() -> None:
    """Print both tables."""
    arguments = tyro.cli(Arguments, description="Speed and exactness of the physics engines.")
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
