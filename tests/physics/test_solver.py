import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose

from dgae_jax.physics.jax import solver


def problems(count, rows=12, size=5):
    """Random convex problems, their minima without rows, and warm starts."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(count, size, size))
    mass = root @ root.swapaxes(1, 2) + 0.1 * np.eye(size)
    smooth = rng.normal(size=(count, size))
    jacobian = rng.normal(size=(count, rows, size)) * rng.integers(0, 2, (count, rows, 1))
    reference = rng.normal(size=(count, rows)) + rng.normal(size=(count, 1))
    stiffness = 10 ** rng.uniform(-1, 3, (count, rows))
    stiffness[::2, -1] = 0  # a row that is not active
    force = np.einsum("wij,wj->wi", mass, smooth)
    arrays = (mass, force, jacobian.swapaxes(1, 2), stiffness, reference)
    problem = solver.Problem(*(jnp.asarray(np.moveaxis(x, 0, -1)) for x in arrays))
    return problem, smooth, jnp.asarray(rng.normal(size=(size, count)))


def optimum(p, smooth, i):
    """The same problem by scipy's quasi-Newton method in float64."""
    mass, _, jacobian_t, stiffness, reference = (np.asarray(x[..., i], float) for x in p)

    def cost(a):
        short = np.minimum(a @ jacobian_t - reference, 0)
        return 0.5 * (a - smooth[i]) @ mass @ (a - smooth[i]) + 0.5 * (stiffness * short**2).sum()

    def slope(a):
        short = np.minimum(a @ jacobian_t - reference, 0)
        return mass @ (a - smooth[i]) + jacobian_t @ (stiffness * short)

    options = {"gtol": 1e-9, "maxiter": 10_000}
    return scipy.optimize.minimize(cost, smooth[i], jac=slope, method="BFGS", options=options).x


def test_solution_is_the_optimum_of_scipy():
    with jax.enable_x64(True):
        p, smooth, guess = problems(60)
        got = jax.jit(solver.solve)(p, guess)
    for i in range(60):
        assert_allclose(got.qacc[:, i], optimum(p, smooth, i), atol=1e-5)
    p, got = jax.tree.map(np.asarray, (p, got))
    inertial = np.einsum("ijw,jw->iw", p.qM, got.qacc) - p.qfrc_smooth
    efc_force = -p.efc_D * np.minimum(got.Jaref, 0)
    assert_allclose(inertial, np.einsum("vcw,cw->vw", p.efc_J, efc_force), atol=1e-7)
    assert int(got.niter.max()) < solver.ITERATIONS


@pytest.mark.parametrize("count", [3, 300])
def test_groups_of_envs_find_what_each_env_finds_alone(count):
    with jax.enable_x64(True):
        p, _, guess = problems(count)
        together, alone = jax.jit(solver.solve)(p, guess), jax.jit(solver.solve)
        for i in range(0, count, 19):
            one = alone(*jax.tree.map(lambda x, i=i: x[..., i : i + 1], (p, guess)))
            assert_allclose(together.qacc[:, i], one.qacc[:, 0], atol=1e-9)


def test_non_finite_problem_ends_and_leaves_the_others_alone():
    p, _, guess = problems(30)
    broken = p._replace(qfrc_smooth=p.qfrc_smooth.at[:, 3].set(jnp.nan))
    got, want = jax.jit(solver.solve)(broken, guess), jax.jit(solver.solve)(p, guess)
    assert jnp.isnan(got.qacc[:, 3]).all()
    others = np.arange(30) != 3
    assert_allclose(got.qacc[:, others], want.qacc[:, others], rtol=1e-5, atol=1e-5)
