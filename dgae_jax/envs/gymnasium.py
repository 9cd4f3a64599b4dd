"""Continuous tasks of Gymnasium under our trainer, stepped on the host one after the other.

A Gymnasium env is a Python object that only goes forward, so the state that JAX sees is half a
state: the seed of the episode and the number of its steps so far. The object must be just there. It
is reset where that number is 0; anything else is an error, never another trajectory. The calls are
custom calls with side effects, which XLA neither drops nor repeats. Each needs the numbers of the
one before, so their order is that of the program.
"""

import itertools
import warnings
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TransformAction
from jaxtyping import Array, Bool, Float, Int, UInt32

from dgae_jax.envs.base import State, ThirdPartyEnv
from dgae_jax.physics import ffi

_count = itertools.count()
_NO_EPISODE = (-1, -1)


class Position(NamedTuple):
    """Seed of an env's episode, high half and low half, and number of its steps so far."""

    seed: UInt32[Array, " 2"]
    steps: Int[Array, ""]


def make_gym_env(name: str, **parameters) -> gymnasium.Env:
    """Make one Gymnasium env, with its own time limit.

    Raises:
        ValueError: if it cannot be made, or its observations and actions are not vectors.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of newer versions
            env = gymnasium.make(name, disable_env_checker=True, **parameters)
    except Exception as reason:  # third-party code may raise anything
        line = f"{type(reason).__name__}: {str(reason).partition(chr(10))[0]}"
        raise ValueError(f"Gymnasium cannot make it: {line}") from reason
    for kind, space in (("actions", env.action_space), ("observations", env.observation_space)):
        vector = isinstance(space, Box) and len(space.shape) == 1
        if not vector or (kind == "actions" and np.dtype(space.dtype).kind != "f"):
            env.close()
            raise ValueError(f"its {kind} are {space}, and must be a Box with one axis of floats")
    space: Any = env.action_space  # its bounds may have been rounded outwards

    def clip(action: np.ndarray) -> np.ndarray:
        return np.clip(action.astype(space.dtype), space.low, space.high)

    return TransformAction(env, clip, space)


class _Envs:
    """Gymnasium envs, one for each env of a call, in its order."""

    def __init__(self, make: Callable[[], gymnasium.Env], first: gymnasium.Env):
        self.make, self.envs = make, [first]
        self.at: list[tuple[int, int]] = [_NO_EPISODE]

    def reset(self, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> None:
        """Map seed [..., 2] and needed [...] to observation [..., O], zero where not needed."""
        seeds, needed = _to_int64(before[0]), before[1].reshape(-1)
        obs = after[0].reshape(len(seeds), -1)
        obs[:] = 0
        for i in np.flatnonzero(needed).tolist():
            obs[i] = self._begin(i, seeds[i])

    def step(self, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> None:
        """Map seed, steps and action to observation, reward, terminated and truncated."""
        seeds, steps = _to_int64(before[0]), before[1].reshape(-1)
        actions = before[2].reshape(len(seeds), -1)
        obs, reward, terminated, truncated = (x.reshape(len(seeds), -1) for x in after)
        for i, at in enumerate(zip(seeds, steps.tolist(), strict=True)):
            if at[1] == 0 and (i >= len(self.envs) or self.at[i] != at):
                self._begin(i, at[0])
            if self.at[i] != at:
                raise RuntimeError("a Gymnasium env only goes forward, never back to a state")
            obs[i], reward[i], terminated[i], truncated[i], _ = self.envs[i].step(actions[i])
            self.at[i] = (at[0], at[1] + 1)

    def _begin(self, i: int, seed: int) -> np.ndarray:
        while i >= len(self.envs):
            self.envs.append(self.make())
            self.at.append(_NO_EPISODE)
        self.at[i] = (seed, 0)
        return self.envs[i].reset(seed=seed)[0]

    def __del__(self):
        for env in self.envs:
            env.close()


def _to_int64(seeds: np.ndarray) -> list[int]:
    """Return seeds of 64 bits from their halves [..., 2]."""
    high, low = seeds.reshape(-1, 2).astype(np.uint64).T
    return (high << np.uint64(32) | low).tolist()


class GymnasiumTask(ThirdPartyEnv):
    """A task of Gymnasium; `done` includes its own truncations, marked in `info["truncation"]`."""

    def __init__(self, name: str, physics: str, **parameters):
        self.backend = physics
        first = make_gym_env(name, **parameters)
        observations: Any = first.observation_space
        actions: Any = first.action_space
        self.observation_size, self.action_size = observations.shape[0], actions.shape[0]
        self.action_range = jnp.asarray(actions.low, float), jnp.asarray(actions.high, float)
        self._envs = _Envs(lambda: make_gym_env(name, **parameters), first)
        # numbered by the order in which a process makes its tasks, so a cached program finds them
        number = next(_count)
        self._reset, self._step = (f"dgae_jax_gymnasium_{number}_{f}" for f in ("reset", "step"))
        # weakly: XLA keeps what it may call for ever, but not the envs of a task that is gone
        reset, step = (weakref.WeakMethod(f) for f in (self._envs.reset, self._envs.step))
        ffi.register(self._reset, lambda before, after: reset()(before, after))  # pyright: ignore
        ffi.register(self._step, lambda before, after: step()(before, after))  # pyright: ignore

    def reset(self, rng: Array) -> State:
        """Begin an episode with a seed drawn from `rng`."""
        return self._begin(rng, jnp.asarray(True))

    def restart(self, state: State, rng: Array, done: Bool[Array, ""]) -> State:
        """Begin an episode where `done`; elsewhere the env is left alone."""
        return self._begin(rng, done)

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Step the env, which must be where `state` is."""
        at: Any = state.pipeline_state
        scalar = jnp.zeros((), state.obs.dtype)
        like = (state.obs, scalar, scalar, scalar)
        obs, reward, terminated, truncated = _call(self._step, like, at.seed, at.steps, action)
        truncated = truncated * (1 - terminated)
        return state.replace(
            pipeline_state=at._replace(steps=at.steps + 1),
            obs=obs,
            reward=reward,
            done=terminated + truncated,
            info={"truncation": truncated},
        )

    def _begin(self, rng: Array, needed: Bool[Array, ""]) -> State:
        seed, zero = jax.random.bits(rng, (2,), jnp.uint32), jnp.zeros(())
        (obs,) = _call(self._reset, (jnp.zeros(self.observation_size),), seed, needed)
        position, info = Position(seed, jnp.int32(0)), {"truncation": zero}
        return State(position, obs, zero, zero, info=info)  # pyright: ignore[reportArgumentType]


def _call(name: str, like: tuple[Any, ...], *arguments: Array) -> Any:
    """Call a registered function; the results have the shapes and types of `like`."""
    shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in like)
    call = jax.ffi.ffi_call(name, shapes, vmap_method="broadcast_all", has_side_effect=True)
    return call(*arguments)
