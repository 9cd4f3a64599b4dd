"""Networks for policies and value distributions: hidden layers, the torso, below a head.

Orthogonal weights, zero biases, tanh between layers; the policy's last layer starts near zero, so that the first
actions are noise around zero (Andrychowicz et al. 2021).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dgae_jax.learn.types import Policy
from dgae_jax.maths.gaussian import Gaussian


class Network(NamedTuple):
    """`init(key) -> params`; `apply(params, obs [..., O]) -> [..., outputs]`."""

    init: Callable
    apply: Callable


def _dense(width: int, scale: float, bias: ArrayLike = 0.0) -> nn.Dense:
    return nn.Dense(width, kernel_init=nn.initializers.orthogonal(scale), bias_init=nn.initializers.constant(bias))


class Torso(nn.Module):
    """Hidden tanh layers; any other flax module of `hidden` may take its place in the modules below."""

    hidden: Sequence[int]

    @nn.compact
    def __call__(self, x: Float[Array, "*batch I"]) -> Float[Array, "*batch H"]:
        for width in self.hidden:
            x = nn.tanh(_dense(width, 2**0.5)(x))
        return x


class Value(nn.Module):
    """Hidden layers and a linear head."""

    hidden: Sequence[int]
    outputs: int
    torso: Callable[[Sequence[int]], nn.Module] = Torso
    bias: ArrayLike = 0.0

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch O"]) -> Float[Array, "*batch K"]:
        return _dense(self.outputs, 1.0, self.bias)(self.torso(self.hidden)(obs))


class SharedCovariance(nn.Module):
    """Mean from the observation, one learned log σ for all observations."""

    hidden: Sequence[int]
    actions: int
    initial_std: ArrayLike
    torso: Callable[[Sequence[int]], nn.Module] = Torso

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch O"]) -> Gaussian:
        mean = _dense(self.actions, 0.01)(self.torso(self.hidden)(obs))
        log_std = self.param("log_std", nn.initializers.constant(jnp.log(self.initial_std)), (self.actions,))
        return Gaussian(mean, jnp.broadcast_to(log_std, mean.shape))


class StateCovariance(nn.Module):
    """Mean and log σ both from the observation; σ is clipped to e⁻⁵ … e², far from overflow in σ⁻²."""

    hidden: Sequence[int]
    actions: int
    initial_std: ArrayLike
    torso: Callable[[Sequence[int]], nn.Module] = Torso

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch O"]) -> Gaussian:
        features = self.torso(self.hidden)(obs)
        mean = _dense(self.actions, 0.01)(features)
        log_std = _dense(self.actions, 0.01, jnp.log(self.initial_std))(features)
        return Gaussian(mean, jnp.clip(log_std, -5.0, 2.0))


def gaussian_policy(
    obs_size: int, action_size: int, *, hidden: Sequence[int], covariance: Callable[..., nn.Module], initial_std: ArrayLike
) -> Policy:
    """A Gaussian policy with mean and diagonal covariance (Sec. results, set-up); `covariance` is one of the two modules above,
    or another of `hidden`, `actions` and `initial_std` that returns a Gaussian.
    """
    module = covariance(tuple(hidden), action_size, initial_std)
    return Policy(lambda key: module.init(key, jnp.zeros(obs_size)), module.apply)


def value_network(
    obs_size: int, outputs: int, *, hidden: Sequence[int], torso: Callable[[Sequence[int]], nn.Module] = Torso, bias: ArrayLike = 0.0
) -> Network:
    """A head of `outputs` numbers, one scalar or K quantiles (Sec. results, set-up), whose biases begin at `bias`."""
    module = Value(tuple(hidden), outputs, torso, bias)
    return Network(lambda key: module.init(key, jnp.zeros(obs_size)), module.apply)
