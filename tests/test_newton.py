import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose

from dgae_jax.physics import newton


def problems(count, rows=12, size=5, seed=0):
    """Random convex problems with every share of active rows, and a guess for each."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, size, size))
    mass = root @ root.swapaxes(1, 2) + 0.1 * np.eye(size)
    smooth = rng.normal(size=(count, size))
    jacobian = rng.normal(size=(count, rows, size)) * rng.integers(0, 2, (count, rows, 1))
    reference = rng.normal(size=(count, rows)) + rng.normal(size=(count, 1))
    stiffness = 10 ** rng.uniform(-1, 3, (count, rows))
    force = np.einsum("wij,wj->wi", mass, smooth)
    problem = newton.Problem(*map(jnp.asarray, (mass, smooth, force, jacobian.swapaxes(1, 2), stiffness, reference)))
    return problem, jnp.asarray(rng.normal(size=(count, size)))


def optimum(p, i):
    """The same problem by scipy's quasi-Newton method in float64, polished by its trust-region method."""
    mass, smooth, _, jacobian_t, stiffness, reference = (np.asarray(x[i], float) for x in p)

    def cost(a):
        short = np.minimum(a @ jacobian_t - reference, 0)
        return 0.5 * (a - smooth) @ mass @ (a - smooth) + 0.5 * (stiffness * short**2).sum()

    def slope(a):
        short = np.minimum(a @ jacobian_t - reference, 0)
        return mass @ (a - smooth) + jacobian_t @ (stiffness * short)

    return scipy.optimize.minimize(cost, smooth, jac=slope, method="BFGS", options={"gtol": 1e-9, "maxiter": 10_000}).x


@pytest.mark.parametrize("seed", range(3))
def test_the_solution_is_the_optimum_that_scipy_finds(seed):
    with jax.enable_x64(True):
        p, guess = problems(20, seed=seed)
        got = jax.jit(jax.vmap(newton.solve))(p, guess)
        for i in range(20):
            assert_allclose(got.acceleration[i], optimum(p, i), atol=1e-5)


def test_at_the_solution_forces_balance():
    with jax.enable_x64(True):
        p, guess = problems(200)
        got = jax.jit(jax.vmap(newton.solve))(p, guess)
        push = -p.stiffness * jnp.minimum(got.residual, 0)
        smooth = jnp.einsum("wij,wj->wi", p.mass, got.acceleration) - p.force
        assert_allclose(smooth, jnp.einsum("wvc,wc->wv", p.jacobian_t, push), atol=1e-7)
        assert int(got.iterations.max()) < newton.ITERATIONS


def test_without_active_rows_the_solution_is_the_smooth_acceleration():
    p, guess = problems(4)
    p = p._replace(reference=jnp.full_like(p.reference, -1e6))
    assert_allclose(jax.vmap(newton.solve)(p, guess).acceleration, p.smooth, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("count", [1, 3, 16, 40, 300])
def test_groups_of_worlds_find_what_each_world_finds_alone(count):
    with jax.enable_x64(True):
        p, guess = problems(count)
        together = jax.jit(jax.vmap(newton.solve))(p, guess)
        alone = jax.jit(newton.solve)
        for i in range(0, count, 7):
            assert_allclose(together.acceleration[i], alone(*jax.tree.map(lambda x, i=i: x[i], (p, guess))).acceleration, atol=1e-9)


def test_a_problem_that_is_not_finite_ends_and_does_not_disturb_the_others():
    p, guess = problems(30)
    broken = p._replace(smooth=p.smooth.at[3].set(jnp.nan))
    got, want = jax.jit(jax.vmap(newton.solve))(broken, guess), jax.jit(jax.vmap(newton.solve))(p, guess)
    assert jnp.isnan(got.acceleration[3]).all()
    others = np.arange(30) != 3
    assert_allclose(got.acceleration[others], want.acceleration[others], rtol=1e-5, atol=1e-5)


def test_the_line_search_is_exact_on_a_kink_by_hand():
    # cost ½(1 - t)²·2 from the step, plus ½·8·min(t - ½ ... )²: one row, r = 1, moving by -2 per unit step, D = 2
    # derivative: -1 + t (step), + 2·(1 - 2t)·(-2) once 1 - 2t < 0: -1 + t - 4 + 8t = 0 at t = 5/9
    length = newton._line_search(jnp.float32(-1.0), jnp.float32(1.0), jnp.array([2.0]), jnp.array([1.0]), jnp.array([-2.0]))
    assert_allclose(length, 5 / 9, rtol=1e-6)
