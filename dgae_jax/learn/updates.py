"""Updates of parameters: the surrogate objective, minibatch gradient descent, the trust region."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike

from dgae_jax.learn import devices
from dgae_jax.learn.types import Batch, Loss, Network, Params, TrainableState, Update
from dgae_jax.maths import gaussian

LOG_RATIO_LIMIT = 20.0
"""Largest |log ρ|: a sample beyond it counts as one at the limit and has no gradient. PPO's clip
and TRPO's KL bound act at ratios near 1; float32 overflows at log ρ = 88.7."""

RADIUS_DECAY_START = 0.8
"""Share of a run after which max_kl decays: a decay from the start learns less on Walker2d."""


def surrogate(policy: Network, clip_eps: ArrayLike = jnp.inf) -> Loss:
    """Return the clipped surrogate loss −E[min(ρA, clip(ρ, 1 ± ε)A)] (Schulman et al. 2017).

    ρ = π(a|s)/π_old(a|s), bounded by `LOG_RATIO_LIMIT`. At the policy that acted the gradient is
    that of −E[A log π] (Eq. gradient_obj_fcn). With an infinite ε it is the plain surrogate ρA.
    """

    def loss(params: Params, batch: Batch):
        distribution = policy.apply(params, batch.obs)
        log_prob = gaussian.log_prob(distribution, batch.action)
        log_ratio = jnp.where(batch.mask, log_prob - batch.log_prob, 0)
        log_ratio = jnp.clip(log_ratio, -LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, jnp.subtract(1, clip_eps), jnp.add(1, clip_eps))
        gain = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
        info = {
            "kl": (ratio - 1 - log_ratio).mean(),
            "entropy": gaussian.entropy(distribution).mean(),
            "clip_fraction": (jnp.abs(ratio - 1) > clip_eps).mean(),
        }
        return -gain.mean(), info

    return loss


OPTIMIZERS: dict[str, Callable[[Any], optax.GradientTransformation]] = {
    "adam": partial(optax.adam, eps=1e-5),  # Andrychowicz et al. 2021
    "rmsprop": partial(optax.rmsprop, decay=0.99, eps=1e-5, eps_in_sqrt=False),  # as in sb3's A2C
}
"""`optimizer(learning rate or schedule)`."""


def linear_schedule(
    start: ArrayLike, end_fraction: ArrayLike, steps: ArrayLike, decay_start: float = 0.0
) -> optax.Schedule:
    """Return a schedule from `start` linearly to `end_fraction` of it, constant afterwards.

    It lasts for `steps`, and the decay begins after the share `decay_start` of them.
    """

    def schedule(count: ArrayLike) -> Array:
        done = jnp.clip((jnp.divide(count, steps) - decay_start) / (1 - decay_start), 0.0, 1.0)
        return jnp.multiply(start, 1 + (end_fraction - 1) * done)

    return schedule


def minibatch_update(
    loss: Loss,
    iterations: ArrayLike,
    *,
    optimizer: str,
    learning_rate: ArrayLike,
    learning_rate_end: ArrayLike,
    epochs: int,
    minibatches: int,
    max_grad_norm: ArrayLike,
) -> Update:
    """Return `epochs` passes over the shuffled batch, `minibatches` optimizer steps each.

    A batch is any tree of arrays [B, …]. The info holds means over all steps. The learning rate
    decays over a run of `iterations`; the options are the settings of the same names in
    `configs.config.FitConfig`.
    """
    steps = iterations * epochs * minibatches
    schedule = linear_schedule(learning_rate, learning_rate_end, steps)
    clip = optax.clip_by_global_norm(max_grad_norm)
    rule = optax.chain(clip, OPTIMIZERS[optimizer](schedule))

    def minibatch_step(state: TrainableState, batch: Any):
        (value, info), gradient = jax.value_and_grad(loss, has_aux=True)(state.params, batch)
        updates, opt_state = rule.update(gradient, state.opt_state, state.params)
        info = {"loss": value, "gradient_norm": optax.global_norm(gradient), **info}
        return TrainableState(optax.apply_updates(state.params, updates), opt_state), info

    def step(key: jax.Array, state: TrainableState, batch: Any):
        size = len(jax.tree.leaves(batch)[0])

        def epoch(state: TrainableState, key: jax.Array):
            order = jax.random.permutation(key, size).reshape(minibatches, -1)
            order = devices.divide(order, axis=1)
            return jax.lax.scan(
                lambda state, rows: minibatch_step(state, jax.tree.map(lambda x: x[rows], batch)),
                state,
                order,
            )

        state, infos = jax.lax.scan(epoch, state, jax.random.split(key, epochs))
        return state, jax.tree.map(jnp.mean, infos)

    return Update(rule.init, step)


def ppo_update(
    policy: Network, iterations: ArrayLike, *, clip_eps: ArrayLike = jnp.inf, **fit
) -> Update:
    """Return minibatch gradient descent on the surrogate: PPO's, or A2C's without `clip_eps`."""
    return minibatch_update(surrogate(policy, clip_eps), iterations, **fit)


def trpo_update(
    policy: Network,
    iterations: ArrayLike,
    *,
    max_kl: ArrayLike,
    learning_rate_end: ArrayLike,
    damping: ArrayLike,
    cg_iterations: int,
    max_backtracks: int,
    fisher_every: int,
) -> Update:
    """Return the natural gradient step of TRPO with a backtracking line search.

    The direction solves (F + damping) x = −∇loss (Schulman et al. 2015), with F the Hessian of the
    mean KL. A step is accepted only if KL(old ‖ new) ≤ `max_kl` and the loss falls; otherwise the
    parameters stay, bit for bit. As in the paper of TRPO the divergence is summed over the A action
    dimensions. sb3-contrib averages it: divide our max_kl and damping by A to get its values.

    Args:
        policy: the policy network.
        iterations: those of the run.
        max_kl: KL bound at the start of the run [nats].
        learning_rate_end: the fraction of it at the end; see `RADIUS_DECAY_START`.
        damping: multiple of the identity added to the Fisher matrix F.
        cg_iterations: iterations of conjugate gradient.
        max_backtracks: times a step is halved before it is given up.
        fisher_every: F is estimated from every n-th sample.
    """
    loss = surrogate(policy)
    schedule = linear_schedule(max_kl, learning_rate_end, iterations, RADIUS_DECAY_START)

    def step(key: jax.Array, state: TrainableState, batch: Batch):
        old, batch, bound = state.params, devices.divide(batch), schedule(state.opt_state)
        (start, info), gradient = jax.value_and_grad(loss, has_aux=True)(old, batch)
        sample = batch.obs[::fisher_every]
        here = policy.apply(old, sample)

        def fisher(v: Params) -> Params:
            """Return (F + damping) v, without forming F."""
            slope = jax.grad(lambda p: gaussian.kl(here, policy.apply(p, sample)).mean())
            return jax.tree.map(lambda f, v: f + damping * v, jax.jvp(slope, (old,), (v,))[1], v)

        descent = jax.tree.map(jnp.negative, gradient)
        direction, _ = jax.scipy.sparse.linalg.cg(fisher, descent, maxiter=cg_iterations, tol=1e-10)
        curvature = optax.tree.vdot(direction, fisher(direction))
        max_step_size = jnp.sqrt(2 * bound / curvature)

        def attempt(halvings):
            new = jax.tree.map(lambda p, d: p + max_step_size * 0.5**halvings * d, old, direction)
            kl = gaussian.kl(policy.apply(old, batch.obs), policy.apply(new, batch.obs)).mean()
            value, info = loss(new, batch)
            return new, value, kl, (kl <= bound) & (value < start), info["entropy"]

        def backtrack(carry):
            halvings, _ = carry
            return halvings + 1, attempt(halvings + 1)

        def rejected(carry):
            halvings, (*_, accepted, _) = carry
            return ~accepted & (halvings < max_backtracks)

        first = jnp.int32(0), attempt(jnp.int32(0))
        halvings, (new, value, kl, accepted, entropy) = jax.lax.while_loop(
            rejected, backtrack, first
        )
        params = jax.tree.map(lambda n, o: jnp.where(accepted, n, o), new, old)
        info = {
            "loss": start,
            "gradient_norm": optax.global_norm(gradient),
            "kl": jnp.where(accepted, kl, 0),
            "entropy": jnp.where(accepted, entropy, info["entropy"]),
            "improvement": jnp.where(accepted, start - value, 0),
            "accepted": accepted.astype(start.dtype),
            "halvings": halvings.astype(start.dtype),
        }
        return TrainableState(params, state.opt_state + 1), info

    return Update(lambda params: jnp.int32(0), step)


UPDATES: dict[str, Callable[..., Update]] = {
    "clip": ppo_update,
    "gradient": ppo_update,
    "trust-region": trpo_update,
}
"""`update(policy, iterations, **options)`."""
