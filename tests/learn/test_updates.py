import jax
import jax.numpy as jnp
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.configs.parts import CRITICS, TARGETS
from dgae_jax.learn import critics
from dgae_jax.learn.networks import SharedCovariance, StateCovariance, gaussian_policy
from dgae_jax.learn.types import Batch, TrainableState
from dgae_jax.learn.updates import adam, descent, sgd, surrogate
from dgae_jax.maths import gaussian
from tests.helpers import distance


@pytest.fixture
def policy():
    return gaussian_policy(3, 2, hidden=(8,), covariance=SharedCovariance, initial_std=1.0)


@pytest.fixture
def params(policy, key):
    return policy.init(key)


@pytest.fixture
def batch(policy, params, key):
    obs, next_obs = jax.random.normal(key, (2, 24, 3))
    distribution = policy.apply(params, obs)
    action = gaussian.sample(key, distribution)
    advantage, reward = jax.random.normal(key, (2, 24))
    log_prob = gaussian.log_prob(distribution, action)
    return Batch(
        obs,
        action,
        log_prob,
        advantage,
        advantage,
        advantage[:, None],
        reward,
        jnp.full(24, 0.9),
        next_obs,
        jnp.ones(24, bool),
    )


@pytest.mark.parametrize("clip", [0.2, jnp.inf])
def test_at_the_acting_policy_the_surrogates_gradient_is_the_policy_gradient(
    clip, policy, params, batch
):
    def policy_gradient(p):
        return -(
            gaussian.log_prob(policy.apply(p, batch.obs), batch.action) * batch.advantage
        ).mean()

    got = jax.grad(surrogate(policy, clip), has_aux=True)(params, batch)[0]
    assert distance(got, jax.grad(policy_gradient)(params)) < 1e-6


def test_at_the_acting_policy_the_ratio_is_exactly_one(policy, params, batch):
    value, info = surrogate(policy, 0.2)(params, batch)
    assert value == -batch.advantage.mean()
    assert info["clip_fraction"] == 0
    assert info["kl"] == 0


def test_the_clip_stops_gradient_where_the_ratio_has_moved_with_the_advantage(
    policy, params, batch
):
    # every ratio is e > 1.2: with positive advantages all gradient is gone, with negative ones none is
    moved = batch._replace(log_prob=batch.log_prob - 1)
    up, down = (moved._replace(advantage=jnp.full(24, a)) for a in (1.0, -1.0))
    loss = jax.grad(surrogate(policy, 0.2), has_aux=True)
    assert float(optax.global_norm(loss(params, up)[0])) == 0
    assert float(optax.global_norm(loss(params, down)[0])) > 0.1
    assert_allclose(surrogate(policy, 0.2)(params, up)[0], -1.2, rtol=1e-6)
    assert_allclose(surrogate(policy, 0.2)(params, down)[0], jnp.e, rtol=1e-5)


@pytest.mark.parametrize("clip", [0.2, jnp.inf])
@pytest.mark.parametrize("log_ratio", [200.0, -200.0])
def test_a_ratio_that_overflows_is_bounded_and_leaves_the_gradient_of_the_others(
    clip, log_ratio, policy, params, batch
):
    wild = batch._replace(
        log_prob=batch.log_prob.at[5].add(-log_ratio), advantage=batch.advantage.at[5].set(-1.0)
    )
    without = batch._replace(
        valid=batch.valid.at[5].set(False), advantage=batch.advantage.at[5].set(0)
    )
    (value, info), got = jax.value_and_grad(surrogate(policy, clip), has_aux=True)(params, wild)
    assert all(jnp.isfinite(x) for x in (value, *info.values()))
    assert distance(got, jax.grad(surrogate(policy, clip), has_aux=True)(params, without)[0]) < 1e-6


def test_the_bound_of_the_ratio_is_exact_below_e_to_the_twentieth(policy, params, batch):
    moved = batch._replace(log_prob=batch.log_prob + jnp.linspace(-19.9, 19.9, 24))

    def unbounded(p):
        return -(
            jnp.exp(gaussian.log_prob(policy.apply(p, moved.obs), moved.action) - moved.log_prob)
            * moved.advantage
        ).mean()

    got, want = (
        jax.grad(surrogate(policy), has_aux=True)(params, moved)[0],
        jax.grad(unbounded)(params),
    )
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert_allclose(a, b, rtol=1e-5)


def test_one_epoch_of_one_minibatch_is_one_optimizer_step_on_the_whole_batch_whatever_the_clip(
    policy, params, batch, key
):
    optimizer = optax.adam(1e-2)
    results = [
        sgd(surrogate(policy, clip), optimizer, epochs=1, minibatches=1).step(
            key, TrainableState(params, optimizer.init(params)), batch
        )[0]
        for clip in (0.2, jnp.inf)
    ]
    gradient = jax.grad(surrogate(policy), has_aux=True)(params, batch)[0]
    want = optax.apply_updates(
        params, optimizer.update(gradient, optimizer.init(params), params)[0]
    )
    assert distance(results[0].params, results[1].params) == 0
    assert distance(results[0].params, want) < 1e-6


def test_an_epoch_visits_every_sample_once(batch, key):
    def loss(params, batch):
        return (params - batch.reward).sum(), {}

    optimizer = optax.sgd(1.0)
    for epochs, minibatches in ((1, 4), (3, 8)):
        fit, info = sgd(loss, optimizer, epochs=epochs, minibatches=minibatches).step(
            key, TrainableState(jnp.zeros(()), optimizer.init(jnp.zeros(()))), batch
        )
        assert_allclose(fit.params, -24.0 * epochs)  # each sample's gradient is 1
        assert_allclose(info["gradient_norm"], 24 / minibatches)


def test_a_batch_that_does_not_divide_is_refused(policy, params, batch, key):
    optimizer = optax.sgd(1.0)
    with pytest.raises(ValueError, match="does not divide into 7"):
        sgd(surrogate(policy), optimizer, epochs=1, minibatches=7).step(
            key, TrainableState(params, optimizer.init(params)), batch
        )


def test_the_learning_rate_falls_linearly_to_its_last_fraction():
    # Adam's first steps on a constant gradient are one learning rate long
    optimizer = descent(adam, 0.1, final_fraction=0.5, gradient_steps=4, max_norm=1e9)
    params = jnp.array([0.0])
    state, steps = optimizer.init(params), []
    for _ in range(6):
        update, state = optimizer.update(jnp.array([1.0]), state, params)
        steps.append(-float(update[0]))
    assert_allclose(steps, [0.1, 0.0875, 0.075, 0.0625, 0.05, 0.05], rtol=1e-3)


def test_the_clip_bounds_the_global_norm_of_a_gradient():
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.sgd(1.0))
    ours = descent(adam, 1.0, final_fraction=1.0, gradient_steps=1, max_norm=1.0)
    gradient = {"a": jnp.array([3.0]), "b": jnp.array([4.0])}
    assert_allclose(optimizer.update(gradient, optimizer.init(gradient))[0]["b"], -0.8)
    moments = ours.update(gradient, ours.init(gradient), gradient)[1]
    assert_allclose(optax.tree_utils.tree_get(moments, "mu")["b"], 0.1 * 0.8, rtol=1e-6)


# ---- critics ----


def critic_of(kind, target):
    options = {} if kind == "scalar" else {"quantiles": 4, "kappa": 1.0}
    return CRITICS[kind].build(3, hidden=(8,), target=TARGETS[target].build, **options)


def test_an_invalid_sample_weighs_nothing_in_policy_and_critic(policy, params, batch, key):
    critic = critics.quantile(3, hidden=(4,), target=critics.SR_LAMBDA, quantiles=1, kappa=1.0)
    values = critic.init(key)
    broken = batch._replace(
        valid=batch.valid.at[5].set(False),
        advantage=batch.advantage.at[5].set(0),
        action=batch.action.at[5].set(0),
        log_prob=batch.log_prob.at[5].set(-1e4),
        target=batch.target.at[5].set(1e9),
    )
    without = jax.tree.map(lambda x: jnp.delete(x, 5, axis=0), batch)
    for loss, at in (
        (surrogate(policy, 0.2), params),
        (surrogate(policy), params),
        (critic.loss, values),
    ):
        got, want = (jax.grad(loss, has_aux=True)(at, b)[0] for b in (broken, without))
        assert distance(jax.tree.map(lambda g: g * 24 / 23, got), want) < 1e-5
    assert surrogate(policy)(params, broken)[1]["kl"] == 0


@pytest.mark.parametrize("kind", CRITICS)
@pytest.mark.parametrize("target", TARGETS)
def test_every_critic_takes_every_target(kind, target, key):
    critic = critic_of(kind, target)
    params, (obs, next_obs) = critic.init(key), jax.random.normal(key, (2, 6, 5, 3))
    reward, factor = jnp.ones((6, 5)), jnp.full((6, 5), 0.9)
    z, z_next = critic.predict(params, obs), critic.predict(params, next_obs)
    got = critic.target(key, reward, factor, factor, z, z_next)
    assert got.shape == (6, 5, 1 if target == "lambda-return" else z.shape[-1])
    empty = jnp.zeros(30)
    seen, then, fit = obs.reshape(30, 3), next_obs.reshape(30, 3), got.reshape(30, -1)
    columns = (
        seen,
        empty[:, None],
        empty,
        empty,
        z.mean(-1).ravel(),
        fit,
        reward.ravel(),
        factor.ravel(),
        then,
    )
    flat = Batch(*columns, valid=jnp.ones(30, bool))
    gradient = jax.grad(critic.loss, has_aux=True)(params, flat)[0]
    assert 0 < float(optax.global_norm(gradient)) < 1e3


def test_the_bellman_target_follows_the_critic_and_the_frozen_one_does_not(batch, key):
    for target, follows in (("bellman", True), ("bellman-frozen", False)):
        critic = critic_of("quantile", target)
        params = critic.init(key)
        fixed = batch._replace(target=jnp.zeros((24, 4)))
        elsewhere = fixed._replace(next_obs=fixed.next_obs + 1)
        assert (critic.loss(params, fixed)[0] != critic.loss(params, elsewhere)[0]) == follows


def test_no_gradient_flows_through_the_bellman_target(batch, key):
    critic = critic_of("scalar", "bellman")
    params = critic.init(key)
    target = batch.reward[:, None] + batch.discount[:, None] * critic.predict(
        params, batch.next_obs
    )
    want = jax.grad(lambda p: (0.5 * (critic.predict(p, batch.obs) - target) ** 2).mean())(params)
    assert distance(jax.grad(critic.loss, has_aux=True)(params, batch)[0], want) < 1e-6


def test_ordered_quantiles_are_fitted_in_the_mean_as_a_scalar_and_in_shape_by_the_crps_about_the_mean_before(
    batch, key
):
    critic = critics.ordered(3, hidden=(), target=critics.BELLMAN_FROZEN, quantiles=8, kappa=1e-5)
    params, target, before = (
        critic.init(key),
        jax.random.normal(key, (24, 5)),
        jnp.linspace(-1, 1, 24),
    )
    at = batch._replace(obs=jnp.zeros((24, 3)), target=target, value=before)

    def by_output(loss):
        """Its derivative by the outputs of the network, which on observations of zero are the biases of its only layer."""
        return jax.grad(loss)(params)["params"]["Dense_0"]["bias"]

    def mean(p):
        return 8 / 2 * (0.5 * (critic.predict(p, at.obs).mean(-1) - target.mean(-1)) ** 2).mean()

    def shape(p):
        z = critic.predict(p, at.obs)
        about = z - z.mean(-1, keepdims=True) + before[:, None]
        return 8 / 2 * jax.vmap(dg.crps, (None, -1))(about, target).mean() / 64

    got = by_output(lambda p: critic.loss(p, at)[0])
    assert_allclose(got[0], by_output(mean)[0], rtol=1e-5)
    assert_allclose(got[1:], by_output(shape)[1:], rtol=1e-3, atol=1e-6)


def test_a_sorted_critic_is_fitted_as_a_quantile_critic_and_predicts_the_same_in_order(batch, key):
    settings = {"hidden": (4,), "target": critics.BELLMAN, "quantiles": 8, "kappa": 1.0}
    plain, monotone_quantiles = (
        critics.quantile(3, **settings),
        critics.sorted_quantile(3, **settings),
    )
    params = plain.init(key)
    predicted = plain.predict(params, batch.obs)
    assert (jnp.diff(predicted) < 0).any()
    assert_array_equal(monotone_quantiles.predict(params, batch.obs), jnp.sort(predicted))
    assert monotone_quantiles.loss(params, batch)[0] == plain.loss(params, batch)[0]


# ---- policy networks ----


@pytest.mark.parametrize("covariance", [SharedCovariance, StateCovariance])
def test_a_fresh_policy_is_wide_noise_around_zero(covariance, key):
    policy = gaussian_policy(3, 2, hidden=(16, 16), covariance=covariance, initial_std=0.7)
    mean, log_std = policy.apply(policy.init(key), jax.random.normal(key, (5, 4, 3)))
    assert mean.shape == log_std.shape == (5, 4, 2)
    assert float(jnp.abs(mean).max()) < 0.05
    assert_allclose(jnp.exp(log_std), 0.7, rtol=0.05)


def test_the_shared_covariance_is_the_same_everywhere_and_the_states_is_not(key):
    obs = jax.random.normal(key, (5, 3))
    for covariance, spread in ((SharedCovariance, False), (StateCovariance, True)):
        policy = gaussian_policy(3, 2, hidden=(16,), covariance=covariance, initial_std=1.0)
        log_std = policy.apply(policy.init(key), obs).log_std
        assert bool((log_std[0] != log_std[1]).any()) == spread


def test_hidden_weights_are_orthogonal(key):
    params = gaussian_policy(8, 2, hidden=(8,), covariance=SharedCovariance, initial_std=1.0).init(
        key
    )
    weight = params["params"]["Torso_0"]["Dense_0"]["kernel"]
    assert_allclose(weight @ weight.T, 2 * jnp.eye(8), atol=1e-5)
    assert_array_equal(params["params"]["Torso_0"]["Dense_0"]["bias"], 0)
