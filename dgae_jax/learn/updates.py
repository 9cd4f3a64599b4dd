"""Updates of parameters: the surrogate objective, stochastic gradient steps on any loss, and the trust region."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike

from dgae_jax.learn import devices
from dgae_jax.learn.types import Batch, Fit, Params, Policy, Update
from dgae_jax.maths import gaussian

Loss = Callable[[Params, Any], tuple[jax.Array, dict[str, jax.Array]]]
"""`loss(params, batch) -> (scalar, info)`; info holds scalars worth logging."""


LOG_RATIO_LIMIT = 20.0
"""Largest |log ρ|: beyond a ratio of e²⁰ ≈ 5·10⁸, or its inverse, a sample counts as one at the limit and has no gradient.

PPO's clip and TRPO's radius act at ratios near 1, so nothing changes there; float32 overflows at log ρ = 88.7.
"""

STEADY = 0.8
"""Share of a run after which the radius of a trust region falls, if it does: one that falls from the start learns less on Walker2d, and
what it is to prevent, that the last step is one too far, is a matter of the end (docs/decisions.md)."""


def surrogate(policy: Policy, clip: ArrayLike = jnp.inf) -> Loss:
    """−E[min(ρA, clip(ρ, 1 ± ε)A)], ρ = π(a|s)/π_old(a|s) (Schulman et al. 2017); without a clip, plain ρA.

    At the policy that acted its gradient is that of −E[A log π] (Eq. gradient_obj_fcn). ρ is bounded by `LOG_RATIO_LIMIT`.
    """

    def loss(params: Params, batch: Batch):
        distribution = policy.apply(params, batch.obs)
        log_ratio = jnp.where(batch.valid, gaussian.log_prob(distribution, batch.action) - batch.log_prob, 0)
        log_ratio = jnp.clip(log_ratio, -LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)
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
    """`epochs` passes over the shuffled batch, any record of arrays [B, …] with `obs`, in `minibatches` optimizer steps each.

    A2C, PPO's policy step and every critic fit are this. The info holds the means over all steps.
    """

    def minibatch(fit: Fit, batch: Any):
        (value, info), gradient = jax.value_and_grad(loss, has_aux=True)(fit.params, batch)
        updates, opt_state = optimizer.update(gradient, fit.opt_state, fit.params)
        info = {"loss": value, "gradient_norm": optax.global_norm(gradient), **info}
        return Fit(optax.apply_updates(fit.params, updates), opt_state), info

    def step(key: jax.Array, fit: Fit, batch: Any):
        size = batch.obs.shape[0]
        if size % minibatches:
            raise ValueError(f"a batch of {size} samples does not divide into {minibatches} minibatches")

        def epoch(fit: Fit, key: jax.Array):
            order = devices.divide(jax.random.permutation(key, size).reshape(minibatches, -1), axis=1)
            return jax.lax.scan(lambda fit, rows: minibatch(fit, jax.tree.map(lambda x: x[rows], batch)), fit, order)

        fit, infos = jax.lax.scan(epoch, fit, jax.random.split(key, epochs))
        return fit, jax.tree.map(jnp.mean, infos)

    return Update(optimizer.init, step)


def trust_region(
    policy: Policy, loss: Loss, *, radius: optax.Schedule, damping: ArrayLike, cg_iterations: int, backtracks: int, fisher_every: int
) -> Update:
    """The natural gradient step to a KL radius, halved until KL and loss accept it (TRPO, Schulman et al. 2015).

    The direction solves (F + damping) x = −∇loss by `cg_iterations` of conjugate gradient, with the Fisher matrix F of every
    `fisher_every`-th sample. A step is taken only if KL(old ‖ new) ≤ `radius` of the number of steps before and the loss falls; if
    none of 1 + `backtracks` lengths is such a step, the parameters stay as they are, bit for bit. As in the paper of TRPO the
    divergence is that of the whole action, summed over its A dimensions; where it is averaged over them (sb3-contrib), radius and
    damping are ours over A.
    """

    def step(key: jax.Array, fit: Fit, batch: Batch):
        old, batch, within = fit.params, devices.divide(batch), radius(fit.opt_state)
        (start, info), gradient = jax.value_and_grad(loss, has_aux=True)(old, batch)
        fisher = fisher_product(policy, old, batch.obs[::fisher_every], damping)
        direction, _ = jax.scipy.sparse.linalg.cg(fisher, jax.tree.map(jnp.negative, gradient), maxiter=cg_iterations, tol=1e-10)
        curvature = optax.tree.vdot(direction, fisher(direction))
        longest = jnp.sqrt(2 * within / curvature)

        def attempt(halvings):
            new = jax.tree.map(lambda p, d: p + longest * 0.5**halvings * d, old, direction)
            moved = gaussian.kl(policy.apply(old, batch.obs), policy.apply(new, batch.obs)).mean()
            value, info = loss(new, batch)
            return new, value, moved, (moved <= within) & (value < start), info["entropy"]

        def search(carry):
            halvings, _ = carry
            return halvings + 1, attempt(halvings + 1)

        def unfinished(carry):
            halvings, (*_, accepted, _) = carry
            return ~accepted & (halvings < backtracks)

        halvings, (new, value, moved, accepted, entropy) = jax.lax.while_loop(unfinished, search, (jnp.int32(0), attempt(jnp.int32(0))))
        params = jax.tree.map(lambda n, o: jnp.where(accepted, n, o), new, old)
        info = {
            "loss": start,
            "gradient_norm": optax.global_norm(gradient),
            "kl": jnp.where(accepted, moved, 0),
            "entropy": jnp.where(accepted, entropy, info["entropy"]),
            "improvement": jnp.where(accepted, start - value, 0),
            "accepted": accepted.astype(start.dtype),
            "halvings": halvings.astype(start.dtype),
        }
        return Fit(params, fit.opt_state + 1), info

    return Update(lambda params: jnp.int32(0), step)


def fisher_product(policy: Policy, params: Params, obs: Array, damping: ArrayLike) -> Callable[[Params], Params]:
    """v ↦ (F + damping) v, F the Hessian of the mean KL from `params` at `params`, without forming it."""
    here = policy.apply(params, obs)

    def slope(params: Params) -> Params:
        return jax.grad(lambda p: gaussian.kl(here, policy.apply(p, obs)).mean())(params)

    def product(v: Params) -> Params:
        return jax.tree.map(lambda f, v: f + damping * v, jax.jvp(slope, (params,), (v,))[1], v)

    return product


def adam(rate) -> optax.GradientTransformation:
    """Adam with the ε of the implementations of PPO (Andrychowicz et al. 2021)."""
    return optax.adam(rate, eps=1e-5)


def rmsprop(rate) -> optax.GradientTransformation:
    """RMSProp as in stable-baselines3's A2C."""
    return optax.rmsprop(rate, decay=0.99, eps=1e-5, eps_in_sqrt=False)


def falling(start: ArrayLike, final_fraction: ArrayLike, steps: ArrayLike, after: float = 0.0) -> optax.Schedule:
    """From `start` linearly to `final_fraction` of it over so many steps, of which the share `after` is constant; constant then.

    The first three may be traced.
    """

    def schedule(count: ArrayLike) -> Array:
        done = jnp.clip((jnp.divide(count, steps) - after) / (1 - after), 0.0, 1.0)
        return jnp.multiply(start, 1 + (final_fraction - 1) * done)

    return schedule


def descent(optimizer: Callable, learning_rate, *, final_fraction, gradient_steps, max_norm) -> optax.GradientTransformation:
    """An optimizer behind a global-norm clip, its rate `falling` over `gradient_steps`."""
    return optax.chain(optax.clip_by_global_norm(max_norm), optimizer(falling(learning_rate, final_fraction, gradient_steps)))


def descend(
    loss: Loss, iterations: ArrayLike, *, optimizer, learning_rate, learning_rate_end, epochs: int, minibatches: int, max_grad_norm
) -> Update:
    """`sgd` on a loss, with a learning rate that falls over a run of `iterations`."""
    steps = iterations * epochs * minibatches
    rule = descent(optimizer, learning_rate, final_fraction=learning_rate_end, gradient_steps=steps, max_norm=max_grad_norm)
    return sgd(loss, rule, epochs=epochs, minibatches=minibatches)


def clipped(policy: Policy, iterations: ArrayLike, *, clip: ArrayLike, **fit) -> Update:
    """PPO: descent on the clipped surrogate."""
    return descend(surrogate(policy, clip), iterations, **fit)


def policy_gradient(policy: Policy, iterations: ArrayLike, **fit) -> Update:
    """A2C: descent on the surrogate without a clip."""
    return descend(surrogate(policy), iterations, **fit)


def natural_gradient(policy: Policy, iterations: ArrayLike, *, radius: ArrayLike, learning_rate_end: ArrayLike, **search) -> Update:
    """TRPO: a natural gradient step on the surrogate within a trust region, whose radius falls at the end of a run of `iterations`."""
    return trust_region(policy, surrogate(policy), radius=falling(radius, learning_rate_end, iterations, STEADY), **search)
