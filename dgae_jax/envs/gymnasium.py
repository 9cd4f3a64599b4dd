"""Continuous tasks of Gymnasium under our trainer: one Gymnasium environment per world, stepped on the host, one after the other.

A world is a Python object that only goes forward. What is a function of its arguments to JAX is therefore only half a state: the seed of
the episode and the number of its steps so far. The world must be just there. It is begun anew where that number is 0; anything else is
an error and never another trajectory. The calls are custom calls with side effects, which XLA neither leaves out nor repeats, and
each needs the numbers of the one before, so that their order is that of the program.
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
from jaxtyping import Array, Bool, Float, Int, UInt32

from dgae_jax.envs.base import Env, State
from dgae_jax.physics import ffi

_count = itertools.count()
_NOWHERE = (-1, -1)  # no episode


class Whereabouts(NamedTuple):
    """Where a world must be."""

    seed: UInt32[Array, " 2"]
    """Of its episode, high half and low half."""
    steps: Int[Array, ""]
    """Since the episode began."""


class InRange(gymnasium.ActionWrapper):
    """A world that takes our actions: in the type that it asks for, where the bounds of its range may be rounded outwards."""

    def action(self, action: np.ndarray) -> np.ndarray:
        """The action as the task takes it."""
        space: Any = self.action_space
        return np.clip(action.astype(space.dtype), space.low, space.high)


def make_world(name: str, **parameters) -> gymnasium.Env:
    """One world of the task that Gymnasium calls `name`, with its own time limit; raises ValueError, with the reason, for one that
    cannot be made or has other observations and actions than rows of numbers.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there is a newer version is no news here
            world = gymnasium.make(name, disable_env_checker=True, **parameters)
    except Exception as reason:  # the code is somebody else's, or missing
        why = str(reason).partition("\n")[0]
        raise ValueError(f"Gymnasium cannot make it: {type(reason).__name__}: {why}") from reason
    for what, space in (("actions", world.action_space), ("observations", world.observation_space)):
        if not (
            isinstance(space, Box)
            and len(space.shape) == 1
            and (what == "observations" or space.dtype.kind == "f")
        ):
            world.close()
            raise ValueError(
                f"its {what} are {space}, and must be a Box with one axis of real numbers"
            )
    return InRange(world)


class _Worlds:
    """The worlds of one environment, as many as a call is for; the i-th of a call is the i-th here."""

    def __init__(self, make: Callable[[], gymnasium.Env], first: gymnasium.Env):
        self.make, self.worlds = make, [first]
        self.at: list[tuple[int, int]] = [_NOWHERE]

    def reset(self, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> None:
        """Begin an episode with the seed [..., 2] where it is `needed` [...]; its observation [..., O], or zeros."""
        seeds, needed = _numbers(before[0]), before[1].reshape(-1)
        obs = after[0].reshape(len(seeds), -1)
        obs[:] = 0
        for i in np.flatnonzero(needed).tolist():
            obs[i] = self._begin(i, seeds[i])

    def step(self, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> None:
        """Seed [..., 2], steps so far [...] and action [..., A]; observation, reward, whether terminated and truncated."""
        seeds, steps = _numbers(before[0]), before[1].reshape(-1)
        actions = before[2].reshape(len(seeds), -1)
        obs, reward, terminated, truncated = (x.reshape(len(seeds), -1) for x in after)
        for i, at in enumerate(zip(seeds, steps.tolist(), strict=True)):
            if at[1] == 0 and (i >= len(self.worlds) or self.at[i] != at):
                self._begin(i, at[0])
            if self.at[i] != at:
                raise RuntimeError(
                    "a world of Gymnasium only goes forward, and was asked to go on from where it is not any more"
                )
            obs[i], reward[i], terminated[i], truncated[i], _ = self.worlds[i].step(actions[i])
            self.at[i] = (at[0], at[1] + 1)

    def _begin(self, i: int, seed: int) -> np.ndarray:
        while i >= len(self.worlds):
            self.worlds.append(self.make())
            self.at.append(_NOWHERE)
        self.at[i] = (seed, 0)
        return self.worlds[i].reset(seed=seed)[0]

    def __del__(self):
        for world in self.worlds:
            world.close()


def _numbers(seeds: np.ndarray) -> list[int]:
    """Seeds of 64 bits from their halves [..., 2]."""
    high, low = seeds.reshape(-1, 2).astype(np.uint64).T
    return (high << np.uint64(32) | low).tolist()


class GymnasiumTask(Env):
    """A task of Gymnasium. `done` includes its own truncations, which `info["truncation"]` marks, as Brax has it."""

    def __init__(self, name: str, **parameters):
        first = make_world(name, **parameters)
        self._actions: Any = first.action_space
        self._observation_size = first.observation_space.shape[0]  # pyright: ignore[reportOptionalSubscript]
        self._worlds = _Worlds(lambda: make_world(name, **parameters), first)
        number = next(
            _count
        )  # by the order in which a process makes its tasks, so that a kept program finds them again
        self._reset, self._step = (
            f"dgae_jax_gymnasium_{number}_{call}" for call in ("reset", "step")
        )
        ffi.register(self._reset, _weak(self._worlds, _Worlds.reset))
        ffi.register(self._step, _weak(self._worlds, _Worlds.step))

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return self._observation_size

    @property
    def action_size(self) -> int:
        """Length of the action."""
        return self._actions.shape[0]

    @property
    def action_range(self) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
        """The lowest and highest action."""
        return jnp.asarray(self._actions.low, float), jnp.asarray(self._actions.high, float)

    @property
    def backend(self) -> str:
        """Name of the physics."""
        return "gymnasium"

    def reset(self, rng: Array) -> State:
        """An episode with a seed drawn from `rng`."""
        return self._begin(rng, jnp.asarray(True))

    def restart(self, state: State, rng: Array, done: Bool[Array, ""]) -> State:
        """An episode with a seed drawn from `rng` where the world is `done`; elsewhere the world is left alone."""
        return self._begin(rng, done)

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """One step of the world, which must be where `state` is."""
        at: Any = state.pipeline_state
        number = jnp.zeros((), state.obs.dtype)
        like = tuple(
            jax.ShapeDtypeStruct(x.shape, x.dtype) for x in (state.obs, number, number, number)
        )
        obs, reward, terminated, truncated = _call(self._step, like, at.seed, at.steps, action)
        cut = truncated * (1 - terminated)
        return state.replace(
            pipeline_state=at._replace(steps=at.steps + 1),
            obs=obs,
            reward=reward,
            done=terminated + cut,
            info={"truncation": cut},
        )

    def _begin(self, rng: Array, needed: Bool[Array, ""]) -> State:
        seed, zero = jax.random.bits(rng, (2,), jnp.uint32), jnp.zeros(())
        (obs,) = _call(
            self._reset,
            (jax.ShapeDtypeStruct((self._observation_size,), zero.dtype),),
            seed,
            needed,
        )
        return State(Whereabouts(seed, jnp.int32(0)), obs, zero, zero, info={"truncation": zero})  # pyright: ignore[reportArgumentType]


def _call(name: str, like: tuple[jax.ShapeDtypeStruct, ...], *arguments: Array) -> Any:
    return jax.ffi.ffi_call(name, like, vmap_method="broadcast_all", has_side_effect=True)(
        *arguments
    )


def _weak(worlds: _Worlds, method: Callable) -> ffi.Function:
    """XLA keeps what it may call for ever, but not the worlds of an environment that is gone."""
    found = weakref.ref(worlds)
    return lambda before, after: method(found(), before, after)


def make(name: str, physics: str, version: None, **parameters) -> Env:
    """The task that Gymnasium calls `name`; raises ValueError as `make_world`."""
    return GymnasiumTask(name, **parameters)
