"""Metrics, evaluations and the learning curve."""

import dataclasses

import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import files, metrics
from dgae_jax.run.metrics import EvaluationsFile, MetricsFile
from tests.runs import SMALL

CONFIG = dataclasses.replace(SMALL, num_envs=10, num_steps=10)


def test_one_row_per_iteration_and_seed(tmp_path):
    config = dataclasses.replace(CONFIG, seed=7, num_seeds=2)
    file = MetricsFile(tmp_path / "metrics.jsonl", config, 0)
    file.append({"episode_return": np.array([[1.5, np.nan], [2.0, 3.0], [0, 0]])}, 2, 1.0)
    file.append({"episode_return": np.array([[4.5, 5.0]])}, 1, 2.0)
    names = "iteration", "steps", "seed", "seconds", "episode_return"
    assert [tuple(row[name] for name in names) for row in metrics.read(file.path)] == [
        (1, 100, 7, 1, 1.5),
        (1, 100, 8, 1, None),
        (2, 200, 7, 1, 2),
        (2, 200, 8, 1, 3),
        (3, 300, 7, 2, 4.5),
        (3, 300, 8, 2, 5),
    ]


def test_metrics_continue_behind_the_checkpoint(tmp_path):
    path, columns = tmp_path / "metrics.jsonl", {"episode_return": np.arange(8.0)[:, None]}
    MetricsFile(path, CONFIG, 0).append(columns, 8, 1.5)
    path.write_text(path.read_text() + '{"iteration": 9, "st')  # torn
    file = MetricsFile(path, CONFIG, 5)
    assert (file.iteration, file.seconds) == (5, 1.5)
    file.append(columns, 2, 2.0)
    assert [row["iteration"] for row in metrics.read(path)] == [1, 2, 3, 4, 5, 6, 7]
    steps, returns = file.curve()
    np.testing.assert_array_equal(steps, 100 * np.arange(1, 8))
    np.testing.assert_array_equal(returns[:, 0], [0, 1, 2, 3, 4, 0, 1])
    before = path.read_bytes()
    with pytest.raises(ConfigError, match="must hold the 8 iterations"):
        MetricsFile(path, CONFIG, 8)
    assert path.read_bytes() == before


MEANS = {100: (1.0, 9.0), 200: (6.0, 6.0), 300: (2.0, 10.0), 400: (5.0, 5.0)}
EVALUATIONS = [
    {"steps": steps, "seed": seed, "return_mean": mean, "return_std": 1.0}
    for steps, means in MEANS.items()
    for seed, mean in enumerate(means)
]


def test_best_evaluation_has_highest_mean_over_seeds(tmp_path):
    path = tmp_path / "evaluations.jsonl"
    assert EvaluationsFile(path).best is None
    files.append_rows(path, EVALUATIONS)
    assert EvaluationsFile(path).best == 300  # of equal ones the later
    assert not EvaluationsFile(path).has(500)
    EvaluationsFile(path).cut(250, 2)
    assert EvaluationsFile(path).best == 200
    points = [[100, 1, 1], [100, 9, 1], [200, 6, 1], [200, 6, 1]]
    np.testing.assert_array_equal(EvaluationsFile(path).points(), points)
    file, means = EvaluationsFile(path), enumerate((99.0, np.nan))
    seeds = [{"seed": i, "return_mean": x, "return_std": 1.0, "returns": [x]} for i, x in means]
    file.append(300, {"seeds": seeds})  # one that diverged is not best
    assert file.best == EvaluationsFile(path).best == 200
    file.cut(1000, 2)
    assert file.best == EvaluationsFile(path).best == 200


@pytest.mark.parametrize(("seeds", "names"), [(1, 2), (3, 3)])
def test_learning_curve_shows_returns_and_evaluations(seeds, names):
    steps = np.arange(1, 301)
    returns = np.sqrt(steps[:, None] + np.arange(seeds))
    returns[:3] = np.nan
    dots = np.array([[100, 10.0, 5.0], [200, 14.0, 3.0]])
    (axes,) = metrics.learning_curve(steps, returns, "title", dots).axes
    assert len(axes.get_legend().get_texts()) == names
    (mean,) = (line for line in axes.lines if line.get_label().startswith("training"))
    np.testing.assert_array_equal(mean.get_data(), [steps, returns.mean(1)])
