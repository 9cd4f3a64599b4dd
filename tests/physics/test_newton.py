import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose

from dgae_jax.physics.jax import newton


def problems(count, rows=12, size=5, seed=0):
    """Random convex problems with every share of active rows, the minimum of each one without rows, and a guess."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, size, size))
    mass = root @ root.swapaxes(1, 2) + 0.1 * np.eye(size)
    smooth = rng.normal(size=(count, size))
    jacobian = rng.normal(size=(count, rows, size)) * rng.integers(0, 2, (count, rows, 1))
    reference = rng.normal(size=(count, rows)) + rng.normal(size=(count, 1))
    stiffness = 10 ** rng.uniform(-1, 3, (count, rows))
    force = np.einsum("wij,wj->wi", mass, smooth)
    arrays = (mass, force, jacobian.swapaxes(1, 2), stiffness, reference)
    return (
        newton.Problem(*(jnp.asarray(np.moveaxis(x, 0, -1)) for x in arrays)),
        smooth,
        jnp.asarray(rng.normal(size=(size, count))),
    )


def optimum(p, smooth, i):
    """The same problem by scipy's quasi-Newton method in float64."""
    mass, _, jacobian_t, stiffness, reference = (np.asarray(x[..., i], float) for x in p)

    def cost(a):
        short = np.minimum(a @ jacobian_t - reference, 0)
        return 0.5 * (a - smooth[i]) @ mass @ (a - smooth[i]) + 0.5 * (stiffness * short**2).sum()

    def slope(a):
        short = np.minimum(a @ jacobian_t - reference, 0)
        return mass @ (a - smooth[i]) + jacobian_t @ (stiffness * short)

    return scipy.optimize.minimize(
        cost, smooth[i], jac=slope, method="BFGS", options={"gtol": 1e-9, "maxiter": 10_000}
    ).x


@pytest.mark.parametrize("seed", range(3))
def test_the_solution_is_the_optimum_that_scipy_finds(seed):
    with jax.enable_x64(True):
        p, smooth, guess = problems(20, seed=seed)
        got = jax.jit(newton.solve)(p, guess)
    for i in range(20):
        assert_allclose(got.acceleration[:, i], optimum(p, smooth, i), atol=1e-5)


def test_at_the_solution_forces_balance():
    with jax.enable_x64(True):
        p, _, guess = problems(200)
        got = jax.jit(newton.solve)(p, guess)
    p, got = jax.tree.map(np.asarray, (p, got))
    inertial = np.einsum("ijw,jw->iw", p.mass, got.acceleration) - p.force
    assert_allclose(inertial, np.einsum("vcw,cw->vw", p.jacobian, got.push), atol=1e-7)
    assert int(got.iterations.max()) < newton.ITERATIONS


def test_without_active_rows_the_solution_is_the_smooth_acceleration():
    p, smooth, guess = problems(4)
    p = p._replace(reference=jnp.full_like(p.reference, -1e6))
    assert_allclose(newton.solve(p, guess).acceleration.T, smooth, rtol=1e-3, atol=1e-4)


def test_a_row_of_zero_stiffness_does_not_count():
    with jax.enable_x64(True):
        p, _, guess = problems(30)
        fewer = newton.Problem(p.mass, p.force, *(x[..., :-1, :] for x in p[2:]))
        same = p._replace(stiffness=p.stiffness.at[-1].set(0))
        assert_allclose(
            newton.solve(same, guess).acceleration,
            newton.solve(fewer, guess).acceleration,
            atol=1e-9,
        )


@pytest.mark.parametrize("count", [1, 3, 16, 40, 300])
def test_groups_of_worlds_find_what_each_world_finds_alone(count):
    with jax.enable_x64(True):
        p, _, guess = problems(count)
        together, alone = jax.jit(newton.solve)(p, guess), jax.jit(newton.solve)
        for i in range(0, count, 7):
            one = alone(*jax.tree.map(lambda x, i=i: x[..., i : i + 1], (p, guess)))
            assert_allclose(together.acceleration[:, i], one.acceleration[:, 0], atol=1e-9)


def test_a_problem_that_is_not_finite_ends_and_does_not_disturb_the_others():
    p, _, guess = problems(30)
    broken = p._replace(force=p.force.at[:, 3].set(jnp.nan))
    got, want = jax.jit(newton.solve)(broken, guess), jax.jit(newton.solve)(p, guess)
    assert jnp.isnan(got.acceleration[:, 3]).all()
    others = np.arange(30) != 3
    assert_allclose(got.acceleration[:, others], want.acceleration[:, others], rtol=1e-5, atol=1e-5)


def test_the_line_search_is_exact_on_a_kink_by_hand():
    # cost ½(1 - t)²·2 from the step, plus ½·8·min(t - ½ ... )²: one row, r = 1, moving by -2 per unit step, D = 2
    # derivative: -1 + t (step), + 2·(1 - 2t)·(-2) once 1 - 2t < 0: -1 + t - 4 + 8t = 0 at t = 5/9
    length = newton._line_search(
        *map(jnp.array, ([-1.0], [1.0], [[2.0]], [[1.0]], [[-2.0]], [False]))
    )
    assert_allclose(length, [5 / 9], rtol=1e-6)
