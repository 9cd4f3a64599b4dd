"""What the strip under a robot shows."""

import dataclasses

import numpy as np
import pytest

from dgae_jax.export import strip
from dgae_jax.export.episodes import Actor, Episode
from dgae_jax.export.strip import Strip, density, shortened
from tests.runs import small


def episode(quantiles, metric="mean", title="name"):
    """Three states; the return that came rises from the lowest to the highest quantile."""
    z = np.sort(np.asarray(quantiles, float))
    config = dataclasses.replace(small("dppo"), metric=metric)
    return Episode(
        Actor(title, None, config, 1.0), 0.5, False, np.zeros((3, 6)), np.zeros((3, 6)), np.array([0.0, 10.0, 1234.0]),
        np.stack([z, z + 1, z + 2]), z.mean() + np.arange(3.0), np.linspace(z.min(), z.max() + 2, 3),
    )  # fmt: skip


SPREAD = np.linspace(0, 4, 64)


def coloured(picture, colour):
    """Columns of the picture that hold about this colour, below the legend."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return np.flatnonzero((np.abs(picture[45:95].astype(int) - rgb).max(-1) < 40).any(0))


@pytest.mark.parametrize("width", [160, 480])
def test_a_strip_has_its_size_in_pixels_and_moves(width):
    drawn = Strip(episode(SPREAD), width)
    pictures = [drawn.picture(t) for t in range(3)]
    assert {picture.shape for picture in pictures} == {(strip.HEIGHT, width, 3)}
    assert pictures[0].dtype == np.uint8
    assert not np.array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(drawn.picture(0), pictures[0])


def test_the_return_that_came_is_a_line_that_moves_to_the_right():
    drawn = Strip(episode(SPREAD), 480)
    at = [coloured(drawn.picture(t), strip.COLOURS["vermilion"]) for t in range(3)]
    assert [len(columns) > 0 for columns in at] == [True] * 3
    assert at[0].max() < at[1].min() < at[1].max() < at[2].min()


def test_the_caption_says_at_the_last_state_that_the_robot_fell():
    standing, fallen = (Strip(episode(SPREAD)._replace(fell=fell), 480) for fell in (False, True))
    for t, same in ((1, True), (2, False)):
        assert np.array_equal(standing.picture(t), fallen.picture(t)) == same


def test_a_scalar_critic_has_a_line_and_no_distribution():
    blue = strip.COLOURS["blue"]
    assert len(coloured(Strip(episode([2.0]), 480).picture(1), blue)) == 0
    assert len(coloured(Strip(episode(SPREAD), 480).picture(1), blue)) > 20


def test_the_rug_is_as_long_as_the_preference_gives_weight():
    blue = strip.COLOURS["blue"]
    neutral, averse = (
        coloured(Strip(episode(SPREAD, metric), 480).picture(1), blue)
        for metric in ("mean", "cvar:0.25")
    )
    span = np.ptp(neutral)
    assert np.ptp(averse) == pytest.approx(0.25 * span, abs=0.06 * span)
    assert averse.min() == neutral.min()


def test_a_density_has_mass_one_and_the_mean_and_spread_of_the_quantiles():
    x = np.linspace(-10, 14, 4000)
    y, step = density(SPREAD, x), x[1] - x[0]
    assert y.sum() * step == pytest.approx(1, abs=1e-6)
    assert (x * y).sum() * step == pytest.approx(2, abs=1e-6)
    kernel = 1.06 * SPREAD.std() * 64**-0.2
    assert ((x - 2) ** 2 * y).sum() * step == pytest.approx(SPREAD.var() + kernel**2, rel=1e-4)
    assert np.isfinite(density(np.zeros(8), x)).all()


def test_a_long_name_loses_its_middle():
    assert shortened("short", 12) == "short"
    assert shortened("hopper-dppo-16x128-0", 11) == "hoppe…128-0"
