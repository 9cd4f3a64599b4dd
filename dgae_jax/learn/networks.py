"""Networks for policies and value distributions: a torso of hidden layers and a head.

Orthogonal weights, zero biases, tanh between layers; the policy's last layer starts near zero, so
that the first actions are noise around zero (Andrychowicz et al. 2021).
"""

from collections.abc import Callable, Sequence

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dgae_jax.learn.types import Network
from dgae_jax.maths.gaussian import Gaussian


def _dense(width: int, scale: float, bias: ArrayLike = 0.0) -> nn.Dense:
    return nn.Dense(
        width,
        kernel_init=nn.initializers.orthogonal(scale),
        bias_init=nn.initializers.constant(bias),
    )


class Torso(nn.Module):
    """Hidden tanh layers; the modules below take any other flax module of `hidden` in its place."""

    hidden: Sequence[int]

    @nn.compact
    def __call__(self, x: Float[Array, "*batch I"]) -> Float[Array, "*batch H"]:
        for width in self.hidden:
            x = nn.tanh(_dense(width, 2**0.5)(x))
        return x


class Value(nn.Module):
    """Hidden layers and a linear head with initial biases `bias` (Sec. results, set-up)."""

    hidden: Sequence[int]
    outputs: int
    torso: Callable[[Sequence[int]], nn.Module] = Torso
    bias: ArrayLike = 0.0

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch O"]) -> Float[Array, "*batch K"]:
        return _dense(self.outputs, 1.0, self.bias)(self.torso(self.hidden)(obs))


class SharedCovariance(nn.Module):
    """Mean from the observation, one log σ for all observations (Sec. results, set-up)."""

    hidden: Sequence[int]
    actions: int
    initial_std: ArrayLike
    torso: Callable[[Sequence[int]], nn.Module] = Torso

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch O"]) -> Gaussian:
        mean = _dense(self.actions, 0.01)(self.torso(self.hidden)(obs))
        initial = nn.initializers.constant(jnp.log(self.initial_std))
        log_std = self.param("log_std", initial, (self.actions,))
        return Gaussian(mean, jnp.broadcast_to(log_std, mean.shape))


class StateCovariance(nn.Module):
    """Mean and log σ from the observation; σ is clipped to e⁻⁵ … e², far from overflow in σ⁻²."""

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


COVARIANCES: dict[str, Callable[..., nn.Module]] = {
    "shared": SharedCovariance,
    "state": StateCovariance,
}
"""Policies with diagonal covariance: modules of `hidden`, `actions` and `initial_std`."""


def network(module: nn.Module, obs_size: int) -> Network:
    """Return the functions of a module that takes observations of this length."""
    return Network(lambda key: module.init(key, jnp.zeros(obs_size)), module.apply)
