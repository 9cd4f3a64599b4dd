"""Learning curves."""

import numpy as np
import pytest
from matplotlib.image import imread

from dgae_jax.run import metrics


@pytest.mark.parametrize("seeds", [1, 3])
def test_the_learning_curve_is_drawn_with_and_without_returns_and_evaluations(seeds, tmp_path):
    returns = np.log(np.arange(1.0, 20)[:, None] + np.arange(seeds))
    returns[:3] = np.nan
    dots = np.array([[100, 2.0, 0.5], [150, 3.0, 0.1]])
    images = []
    for name, figure in (
        ("none", metrics.learning_curve(np.arange(1, 4), returns[:3], "title")),
        ("curve", metrics.learning_curve(10 * np.arange(1, 20), returns, "title")),
        ("dots", metrics.learning_curve(10 * np.arange(1, 20), returns, "title", dots)),
    ):
        metrics.save_figure(figure, tmp_path / f"{name}.png")
        images.append(imread(tmp_path / f"{name}.png")[..., :3])

    def share(image, red, green, blue):
        return np.mean(np.abs(image - np.array([red, green, blue]) / 255).max(-1) < 0.1)

    blue, orange = (31, 119, 180), (255, 127, 14)
    assert [share(image, *blue) > 0.001 for image in images[1:]] == [True, True]
    assert [share(image, *orange) > 0.0001 for image in images] == [False, False, True]
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["curve.png", "dots.png", "none.png"]


def test_a_long_run_is_drawn_from_its_first_to_its_last_iteration_in_a_thousand_points():
    steps = np.arange(1, 30_001)
    line = metrics.learning_curve(steps, np.sqrt(steps)[:, None], "title").axes[0].lines[0]
    x, y = (np.asarray(each) for each in line.get_data())
    assert (len(x), x[0], x[-1]) == (1000, 1, 30_000)
    np.testing.assert_array_equal(y, np.sqrt(x))


@pytest.mark.parametrize(
    ("seeds", "labels"),
    [(1, ["training"]), (3, ["training, mean of 3 seeds", "± 1 standard deviation of seeds"])],
)
def test_the_legend_names_every_line(seeds, labels):
    figure = metrics.learning_curve(np.arange(5), np.ones((5, seeds)), "title", np.ones((2, 3)))
    texts = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert texts == [*labels, "deterministic policy, mean ± std"]
