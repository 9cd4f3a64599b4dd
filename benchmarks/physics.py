"""Speed, compile time and exactness of the physics, side by side in one run on one core.

    taskset -c 0 python benchmarks/physics.py

For each task: environment steps per second of C MuJoCo (one thread), of our `mjx` and of stock `mjx.step`, under random
actions; and the error of one environment step in `mjx` against Gymnasium from the same state, over states visited by
random and held actions, and by the policies of `--runs` (run directories of experiments/train.py). Nothing else should
run on the machine meanwhile. With `--device gpu` the JAX rows are measured on the GPU.
"""

import dataclasses
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx as mujoco_mjx
from mujoco.batch import Batch

import dgae_jax as dg
from dgae_jax.cli.arguments import parse
from dgae_jax.configs.build import make_greedy, make_task
from dgae_jax.envs.registry import TASKS
from dgae_jax.envs.task import load_spec
from dgae_jax.physics.jax.engine import jax_engine
from dgae_jax.run import checkpoint, directory


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """Tasks."""
    worlds: tuple[int, ...] = (64, 512, 2048)
    """Batch sizes [worlds]."""
    steps: int = 20
    """Environment steps per measurement; the fastest of three counts."""
    states: int = 1000
    """States to compare at, per source."""
    stock: bool = True
    """Measure stock mjx.step too (slow to compile)."""
    runs: tuple[Path, ...] = ()
    """Run directories whose policies visit states too."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Device of the JAX rows."""
    x64: bool = False
    """Compare in float64."""


def fastest(run: Callable[[], Any], times: int = 3) -> float:
    """Seconds of the fastest of some runs."""
    seconds = []
    for _ in range(times):
        since = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - since)
    return min(seconds)


def c_speed(name: str, worlds: int, steps: int) -> float:
    """C MuJoCo on one thread, under new random controls at every step."""
    task = TASKS[name]
    model = load_spec(task.FILE["v4"]).compile()
    batch, rng = Batch(model, worlds, 1), np.random.default_rng(0)
    controls = rng.uniform(-1, 1, (steps, worlds, model.nu))
    batch.bind("qpos")[:] = model.qpos0

    def run():
        for control in controls:
            batch.bind("ctrl")[:] = control
            batch.step(nstep=task.FRAME_SKIP)

    run()
    return worlds * steps / fastest(run)


def jax_speed(step: Callable, state: Any, controls: int, worlds: int, steps: int) -> tuple[float, float]:
    """Environment steps per second and seconds to compile, of a step on one world."""

    @jax.jit
    def run(state, key):
        def one(state, key):
            return jax.vmap(step)(state, jax.random.uniform(key, (worlds, controls), minval=-1, maxval=1)), None

        return jax.lax.scan(one, state, jax.random.split(key, steps))[0]

    state = jax.tree.map(lambda x: jnp.broadcast_to(x, (worlds, *jnp.shape(x))), state)
    since = time.perf_counter()
    compiled = run.lower(state, jax.random.key(0)).compile()
    seconds = time.perf_counter() - since
    state = jax.block_until_ready(compiled(state, jax.random.key(0)))
    return worlds * steps / fastest(lambda: jax.block_until_ready(compiled(state, jax.random.key(1)))), seconds


def ours(name: str, worlds: int, steps: int) -> tuple[float, float]:
    """Our step."""
    task = TASKS[name]
    physics = jax_engine(load_spec(task.FILE["v4"]), task.FRAME_SKIP, max_contacts=task.CONTACTS)
    start = physics.at_pose(jnp.asarray(physics.model.qpos0), jnp.zeros(physics.model.nv))
    return jax_speed(physics.step, start, physics.model.nu, worlds, steps)


def stock(name: str, worlds: int, steps: int) -> tuple[float, float]:
    """`mjx.step` as it comes, without the model's own numerics, through which MJX 3.17 limits the wrong thing."""
    task, spec = TASKS[name], load_spec(TASKS[name].FILE["v4"])
    for numeric in list(spec.numerics):
        spec.delete(numeric)
    model = spec.compile()
    m = mujoco_mjx.put_model(model)

    def step(data, control):
        return jax.lax.scan(lambda d, _: (mujoco_mjx.step(m, d), None), data.replace(ctrl=control), None, length=task.FRAME_SKIP)[0]

    return jax_speed(step, mujoco_mjx.make_data(m), model.nu, worlds, steps)


def speeds(name: str, arguments: Arguments) -> None:
    """A row per batch size."""
    for worlds in arguments.worlds:
        reference = c_speed(name, worlds, arguments.steps)
        speed, compiling = ours(name, worlds, arguments.steps)
        row = f"{name:9s} {worlds:6,} {reference:9,.0f} {speed:9,.0f} {speed / reference:6.2f} {compiling:7.1f}"
        if arguments.stock:
            slow, slow_compiling = stock(name, worlds, max(1, arguments.steps // 10))
            row += f" {slow:9,.0f} {speed / slow:6.1f} {slow_compiling:7.1f}"
        print(row, flush=True)


def gymnasium_task(name: str):
    """Gymnasium's v4 task."""
    gymnasium.logger.min_level = gymnasium.logger.ERROR
    return gymnasium.make(f"{TASKS[name].NAME}-v4").unwrapped


def visited(name: str, count: int, act: Callable[[np.ndarray], np.ndarray] | None, dtype: type) -> tuple[np.ndarray, ...]:
    """Poses with the action taken there: of `act`, or random and held actions, episodes of 50 steps that go on when fallen."""
    gym, rng, kept, episode = gymnasium_task(name), np.random.default_rng(0), [], 0
    while len(kept) < count:
        obs, _ = gym.reset(seed=episode)
        held, episode = rng.uniform(-1, 1, gym.action_space.shape), episode + 1
        for _ in range(50 if act is None else 200):
            action = act(obs) if act else (held if episode % 2 else rng.uniform(-1, 1, held.shape))
            action = np.asarray(action, np.float32)
            kept.append((gym.data.qpos.astype(dtype), gym.data.qvel.astype(dtype), action.astype(dtype)))
            obs = gym.step(action)[0]
    return tuple(np.stack(x) for x in zip(*kept[:count], strict=True))


def errors(name: str, poses: tuple[np.ndarray, ...]) -> str:
    """Observation and reward errors of one step of our `mjx` from each pose."""
    env, gym = dg.make_env(name, physics="jax"), gymnasium_task(name)

    @jax.jit
    def step(key, qpos, qvel, action):
        return jax.vmap(lambda q, v, a: env.step(env.set_state(env.reset(key), q, v), a))(qpos, qvel, action)

    after = step(jax.random.key(0), *map(jnp.asarray, poses))
    observation, reward, contacts = [], [], []
    for i, (qpos, qvel, action) in enumerate(zip(*poses, strict=True)):
        gym.reset()
        gym.set_state(qpos.astype(float), qvel.astype(float))
        obs, theirs, *_ = gym.step(action)
        observation.append(np.abs(obs - np.asarray(after.obs[i])).max())
        reward.append(abs(float(theirs) - float(after.reward[i])))
        contacts.append(gym.data.ncon)
    median, most, worst = np.quantile(observation, (0.5, 0.99, 1))
    return f"{median:9.1e} {most:9.1e} {worst:9.1e} {max(reward):9.1e} {max(contacts):8d}"


def policy_of(run_dir: Path) -> tuple[str, Callable[[np.ndarray], np.ndarray]]:
    """The task of a run and its mean action."""
    config = dataclasses.replace(directory.read_config(run_dir), physics="native")
    with jax.enable_x64(False):  # policies are float32
        state = jax.tree.map(lambda x: x[0], checkpoint.newest(run_dir, config)[0])
        greedy = jax.jit(make_greedy(make_task(config), config))

    def act(obs: np.ndarray) -> np.ndarray:
        with jax.enable_x64(False):
            return np.asarray(greedy(state, obs.astype(np.float32)))

    return config.env, act


def main() -> None:
    """Print both tables."""
    arguments = parse(Arguments, "Speed and exactness of the physics.")
    jax.config.update("jax_enable_compilation_cache", False)
    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[arguments.device])
    jax.config.update("jax_enable_x64", arguments.x64)
    warnings.simplefilter("ignore")
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}; environment steps per second")
    print(f"{'task':9s} {'worlds':>6s} {'C':>9s} {'mjx':>9s} {'/ C':>6s} {'compile':>7s} {'stock':>9s} {'×':>6s} {'compile':>7s}")
    for name in arguments.tasks:
        speeds(name, arguments)
    print(f"one step against Gymnasium, {'float64' if arguments.x64 else 'float32'}: error of the observation and the reward")
    print(f"{'task':9s} {'states of':12s} {'median':>9s} {'99 %':>9s} {'worst':>9s} {'reward':>9s} {'contacts':>8s}")
    dtype = np.float64 if arguments.x64 else np.float32
    policies = [(name, None) for name in arguments.tasks] + [policy_of(run) for run in arguments.runs]
    for name, act in policies:
        if name in arguments.tasks:
            poses = visited(name, arguments.states, act, dtype)
            print(f"{name:9s} {'a policy' if act else 'random':12s} {errors(name, poses)}", flush=True)


if __name__ == "__main__":
    main()
