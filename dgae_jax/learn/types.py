"""The records that flow through the trainer: data, networks in training, and the parts of an algorithm.

Leading axes: T time steps of a rollout, N parallel worlds, B = T·N flattened samples, K quantiles, A actions.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float, Int, Key

Params = Any
"""A pytree of network parameters."""


class Transition(NamedTuple):
    """The data of a rollout. `next_obs` is the true successor, never a reset observation."""

    obs: Float[Array, "T N O"]
    action: Float[Array, "T N A"]
    log_prob: Float[Array, "T N"]
    reward: Float[Array, "T N"]
    terminated: Bool[Array, "T N"]
    truncated: Bool[Array, "T N"]
    next_obs: Float[Array, "T N O"]
    valid: Bool[Array, "T N"]
    """False where the world turned non-finite: that step weighs nothing in any loss, standardisation or running scale."""


class Batch(NamedTuple):
    """The samples that the updates learn from; observations are normalised, rewards scaled.

    `reward`, `discount` and `next_obs` serve targets that are recomputed with the current critic.
    """

    obs: Float[Array, "B O"]
    action: Float[Array, "B A"]
    log_prob: Float[Array, " B"]
    advantage: Float[Array, " B"]
    value: Float[Array, " B"]
    """The mean that the critic predicted which acted."""
    target: Float[Array, "B J"]
    reward: Float[Array, " B"]
    discount: Float[Array, " B"]
    next_obs: Float[Array, "B O"]
    valid: Bool[Array, " B"]
    """Where False, the sample weighs nothing in any loss."""


class Fit(NamedTuple):
    """One network in training."""

    params: Params
    opt_state: Any


class Fitted(NamedTuple):
    """A network as it is used: all that is needed to act, or to predict."""

    params: Params
    observations: Any
    """Running mean and standard deviation by which observations are normalised; None if they are used as they are."""


class TrainState(NamedTuple):
    """Everything an iteration reads and writes; the whole of a run."""

    policy: Fit
    critic: Fit
    observations: Any
    """Running mean and standard deviation of observations; None if they are not normalised."""
    reward_scale: Any
    """Running standard deviation of discounted returns, by which rewards are divided."""
    episodes: Any
    """The worlds and the bookkeeping of their episodes."""
    key: Key[Array, ""]
    iteration: Int[Array, ""]
    failures: Int[Array, ""]
    """Iterations in a row in which an update was not finite and was left out, or more than half of the world steps were invalid."""


class Policy(NamedTuple):
    """`init(key) -> params`; `apply(params, obs [..., O]) -> Gaussian` over actions [..., A]."""

    init: Callable
    apply: Callable


class Critic(NamedTuple):
    """A value distribution: its prediction, the target it is fitted to, and the loss between the two."""

    init: Callable
    """`init(key) -> params`."""
    predict: Callable
    """`predict(params, obs [..., O]) -> quantiles [..., K]`."""
    target: Callable
    """`target(key, reward, discount, trace, quantiles, next_quantiles) -> [T, N, J]`, of the critic that acted."""
    loss: Callable
    """`loss(params, batch) -> (scalar, info)`."""
    lam: float | None = None
    """λ of the target's trace where it is not that of the advantages."""


class Update(NamedTuple):
    """`init(params) -> opt_state`; `step(key, fit, batch) -> (fit, info)`."""

    init: Callable
    step: Callable


class Algorithm(NamedTuple):
    """A policy-gradient algorithm is this record; the six names of the paper are rows of one table."""

    policy: Policy
    critic: Critic
    residual: Callable
    """`residual(reward, discount, quantiles, next_quantiles) -> δ`, the one thing DGAE changes."""
    policy_update: Update
    critic_update: Update
