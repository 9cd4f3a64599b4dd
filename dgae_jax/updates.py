"""How parameters move: the surrogate objective, and stochastic gradient steps on any loss."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike

from dgae_jax import gaussian
from dgae_jax.types import Batch, Fit, Params, Policy, Update

Loss = Callable[[Params, Batch], tuple[jax.Array, dict[str, jax.Array]]]
"""`loss(params, batch) -> (scalar, info)`; info holds scalars worth logging."""


def surrogate(policy: Policy, clip: ArrayLike = jnp.inf) -> Loss:
    """−E[min(ρA, clip(ρ, 1 ± ε)A)], ρ = π(a|s)/π_old(a|s) (Schulman et al. 2017); without a clip, plain ρA.

    At the policy that acted its gradient is that of −E[A log π] (Eq. gradient_obj_fcn).
    """

    def loss(params: Params, batch: Batch):
        distribution = policy.apply(params, batch.obs)
        log_ratio = gaussian.log_prob(distribution, batch.action) - batch.log_prob
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, jnp.subtract(1, clip), jnp.add(1, clip))
        gain = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
        info = {
            "kl": (ratio - 1 - log_ratio).mean(),
            "entropy": gaussian.entropy(distribution).mean(),
            "clip_fraction": (jnp.abs(ratio - 1) > clip).mean(),
        }
        return -gain.mean(), info

    return loss


def sgd(loss: Loss, optimizer: optax.GradientTransformation, *, epochs: int, minibatches: int) -> Update:
    """`epochs` passes over the shuffled batch in `minibatches` optimizer steps each.

    A2C, PPO's policy step and every critic fit are this. The info holds the means over all steps.
    """

    def minibatch(fit: Fit, batch: Batch):
        (value, info), gradient = jax.value_and_grad(loss, has_aux=True)(fit.params, batch)
        updates, opt_state = optimizer.update(gradient, fit.opt_state, fit.params)
        info = {"loss": value, "gradient_norm": optax.global_norm(gradient), **info}
        return Fit(optax.apply_updates(fit.params, updates), opt_state), info

    def step(key: jax.Array, fit: Fit, batch: Batch):
        size = batch.obs.shape[0]
        if size % minibatches:
            raise ValueError(f"a batch of {size} samples does not divide into {minibatches} minibatches")

        def epoch(fit: Fit, key: jax.Array):
            order = jax.random.permutation(key, size).reshape(minibatches, -1)
            return jax.lax.scan(lambda fit, rows: minibatch(fit, jax.tree.map(lambda x: x[rows], batch)), fit, order)

        fit, infos = jax.lax.scan(epoch, fit, jax.random.split(key, epochs))
        return fit, jax.tree.map(jnp.mean, infos)

    return Update(optimizer.init, step)


def adam(learning_rate, *, final_fraction, gradient_steps, max_norm) -> optax.GradientTransformation:
    """Adam behind a global-norm clip, its rate falling linearly to `final_fraction` of its start over `gradient_steps`.

    All four may be traced. ε = 1e-5 follows the implementations of PPO (Andrychowicz et al. 2021).
    """

    def schedule(count: ArrayLike) -> Array:
        done = jnp.minimum(jnp.divide(count, gradient_steps), 1.0)
        return learning_rate * (1 + (final_fraction - 1) * done)

    return optax.chain(optax.clip_by_global_norm(max_norm), optax.adam(schedule, eps=1e-5))
