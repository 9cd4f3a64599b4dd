"""Fig. 2: what is printed in it, against closed forms."""

import math
from statistics import NormalDist

import pytest

from dgae_jax.export import transport
from dgae_jax.export.transport import HIGHER, LOWER, distances


@pytest.mark.parametrize(("a", "b"), [(1.0, 3.5), (2.0, -1.0)])
def test_two_normals_of_the_same_shape_are_as_far_apart_as_their_means_and_the_directional_metric_has_the_sign(
    a, b
):
    found = distances(NormalDist(a, 0.7), NormalDist(b, 0.7))
    assert found.wasserstein == pytest.approx(abs(a - b), rel=1e-5)
    assert found.forward == pytest.approx(a - b, rel=1e-5)
    assert found.backward == pytest.approx(b - a, rel=1e-5)


def test_of_two_normals_with_the_same_mean_neither_is_superior_though_mass_is_moved():
    found = distances(NormalDist(0, 1), NormalDist(0, 2))
    assert found.wasserstein == pytest.approx(math.sqrt(2 / math.pi), abs=2e-3)  # E|2Z − Z|
    assert found.forward == pytest.approx(0, abs=1e-6)


def test_both_columns_print_the_same_distance_and_opposite_directions():
    titles = [axes.get_title() for axes in transport.figure().axes if axes.get_title()]
    assert len(titles) == 2
    gap = HIGHER.mean - LOWER.mean
    assert all(f"d_1 = {gap:.2f}" in title for title in titles)
    assert [
        f"d(F_U, G_V) = {{{sign}}}{gap:.2f}" in title
        for sign, title in zip("-+", titles, strict=True)
    ] == [True, True]
    assert [
        f"d(G_V, F_U) = {{{sign}}}{gap:.2f}" in title
        for sign, title in zip("+-", titles, strict=True)
    ] == [True, True]


def test_arrows_of_the_plan_lead_from_each_quantile_of_u_to_the_same_of_v():
    panels = transport.figure().axes
    for axes, (u, v) in zip(panels[2:], ((LOWER, HIGHER), (HIGHER, LOWER)), strict=True):
        ends = [tuple(arrow._posA_posB) for arrow in axes.patches]
        assert ends == [((u.inv_cdf(q), q), (v.inv_cdf(q), q)) for q in transport.LEVELS]
