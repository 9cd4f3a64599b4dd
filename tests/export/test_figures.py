"""The figures of the paper: what is printed in them, against closed forms."""

import math
import subprocess
import sys
from itertools import pairwise
from statistics import NormalDist

import numpy as np
import pytest
from PIL import Image

from dgae_jax.export import figures
from dgae_jax.export.figures import HIGHER, LOWER, distances
from tests.helpers import ROOT


def test_directional_metric_is_the_difference_of_means():
    found = distances(NormalDist(2.0, 0.7), NormalDist(-1.0, 0.7))
    assert found == pytest.approx([3, 3, -3], rel=1e-5)
    found = distances(NormalDist(0, 1), NormalDist(0, 2))
    assert found[0] == pytest.approx(math.sqrt(2 / math.pi), abs=2e-3)  # E|2Z − Z|
    assert found[1] == pytest.approx(0, abs=1e-6)


def test_transport_prints_distances_and_draws_the_plan():
    panels = figures.transport().axes
    gap = f"{HIGHER.mean - LOWER.mean:.2f}"
    for axes, sign, other in zip(panels, "-+", "+-", strict=False):
        title = axes.get_title()
        assert f"d_1 = {gap}" in title
        assert f"d(F_U, G_V) = {sign}{gap}" in title
        assert f"d(G_V, F_U) = {other}{gap}" in title
    for axes, (u, v) in zip(panels[2:], ((LOWER, HIGHER), (HIGHER, LOWER)), strict=True):
        ends = [tuple(arrow._posA_posB) for arrow in axes.patches]
        assert ends == [((u.inv_cdf(q), q), (v.inv_cdf(q), q)) for q in figures.LEVELS]


def test_transport_has_the_same_bytes_each_time(tmp_path):
    for name in ("first.svg", "second.svg"):
        figures.save(figures.transport(), tmp_path / name)
    assert (tmp_path / "first.svg").read_bytes() == (tmp_path / "second.svg").read_bytes()


def test_robots_are_four_different_pictures_on_light_ground(tmp_path, opengl):
    command = [sys.executable, "experiments/figures.py", "--only", "robots", "--out", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True)
    with Image.open(tmp_path / "robots.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    quarters = np.array_split(pixels[:, : pixels.shape[1] // 4 * 4], 4, axis=1)
    for quarter in quarters:
        brown = (np.abs(quarter - (204, 153, 102)).max(-1) < 60).mean()
        assert 0.005 < brown < 0.5
        assert quarter.mean() > 150
    assert all(np.abs(a - b).mean() > 3 for a, b in pairwise(quarters))
