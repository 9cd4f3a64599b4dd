"""The records that flow through the trainer: data, networks in training, and parts of an algorithm.

Leading axes: T time steps of a rollout, N parallel envs, B = T·N flattened samples, K quantiles,
A action dimensions.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Int, Key

from dgae_jax.maths.returns import Quantiles, Steps

Params = Any
"""A pytree of network parameters."""
Metrics = dict[str, Array]
"""Scalars worth logging, by name."""


class Transition(NamedTuple):
    """The data of a rollout. `next_obs` is the true successor, never a reset observation."""

    obs: Float[Array, "T N O"]
    action: Float[Array, "T N A"]
    log_prob: Float[Array, "T N"]
    reward: Float[Array, "T N"]
    terminated: Bool[Array, "T N"]
    truncated: Bool[Array, "T N"]
    next_obs: Float[Array, "T N O"]
    mask: Bool[Array, "T N"]
    """False where the env turned non-finite: the step has no weight in any loss or statistic."""


class Batch(NamedTuple):
    """The samples of an iteration; observations are normalized, rewards scaled.

    `reward`, `discount` and `next_obs` serve targets that are recomputed with the current critic.
    """

    obs: Float[Array, "B O"]
    action: Float[Array, "B A"]
    log_prob: Float[Array, " B"]
    advantage: Float[Array, " B"]
    value: Float[Array, " B"]
    """Value estimate at rollout time."""
    target: Float[Array, "B J"]
    reward: Float[Array, " B"]
    discount: Float[Array, " B"]
    next_obs: Float[Array, "B O"]
    mask: Bool[Array, " B"]
    """False where the sample has no weight in any loss."""


class TrainableState(NamedTuple):
    """A network in training."""

    params: Params
    opt_state: Any


class InferenceState(NamedTuple):
    """A network in use: all that acting or predicting needs."""

    params: Params
    obs_stats: Any


class TrainState(NamedTuple):
    """Everything that an iteration reads and writes; the whole of a run."""

    policy: TrainableState
    critic: TrainableState
    obs_stats: Any
    """Running mean and standard deviation of observations; None if they are not normalized."""
    reward_scale: Any
    """Running standard deviation of discounted returns, by which rewards are divided."""
    episodes: Any
    """The envs and the bookkeeping of their episodes."""
    key: Key[Array, ""]
    iteration: Int[Array, ""]
    failures: Int[Array, ""]
    """Iterations in a row with a skipped update, or with most env steps masked."""


@runtime_checkable
class TargetFn(Protocol):
    """Targets [T, N, J] of a critic's fit, from predictions of the critic at rollout time.

    `trace` is λ(1 − done) and `discount` γ(1 − terminated); one signature for all targets.
    """

    def __call__(
        self,
        key: Key[Array, ""] | None,
        reward: Steps,
        discount: Steps,
        trace: Steps | None,
        quantiles: Quantiles | None,
        next_quantiles: Quantiles,
    ) -> Float[Array, "*steps J"]: ...


@runtime_checkable
class Loss(Protocol):
    """Mean loss of a batch, and scalars worth logging."""

    def __call__(self, params: Params, batch: Any) -> tuple[Float[Array, ""], Metrics]: ...


@runtime_checkable
class Residual(Protocol):
    """TD error δ from the predictions before and after each step: the part that DGAE changes."""

    def __call__(
        self, reward: Steps, discount: Steps, quantiles: Quantiles, next_quantiles: Quantiles
    ) -> Steps: ...


@runtime_checkable
class UpdateStep(Protocol):
    """One iteration's update of a network, and scalars worth logging."""

    def __call__(
        self, key: Key[Array, ""], state: TrainableState, batch: Any
    ) -> tuple[TrainableState, Metrics]: ...


class Network(NamedTuple):
    """A network."""

    init: Callable[[Key[Array, ""]], Params]
    """`init(key) -> params`."""
    apply: Callable[[Params, Array], Any]
    """`apply(params, obs [..., O])`; that of a policy returns a `Gaussian` of actions [..., A]."""


class Critic(NamedTuple):
    """A value distribution: its prediction, the target of its fit, and the loss between them."""

    init: Callable[[Key[Array, ""]], Params]
    predict: Callable[[Params, Array], Quantiles]
    """`predict(params, obs [..., O]) -> [..., K]`; K = 1 for a scalar critic."""
    target: TargetFn
    loss: Loss
    lam: float | None = None
    """λ of the target's trace where it differs from that of the advantages."""


class Update(NamedTuple):
    """Update of a network."""

    init: Callable[[Params], Any]
    """`init(params) -> opt_state`."""
    step: UpdateStep


class Algorithm(NamedTuple):
    """A policy-gradient algorithm; the six names of the paper are rows of `configs.algorithms`."""

    policy: Network
    critic: Critic
    residual: Residual
    policy_update: Update
    critic_update: Update
