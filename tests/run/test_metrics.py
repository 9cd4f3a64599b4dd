"""The growing file of metrics."""

import numpy as np
import pytest

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.run import metrics


def test_metrics_are_one_json_object_per_run_and_iteration(tmp_path):
    config = dg.Config(seed=7, num_seeds=2, num_envs=10, num_steps=10)
    file = metrics.MetricsFile(tmp_path / "metrics.jsonl", config, 0)
    columns = {
        "episode_return": np.array([[1.5, np.nan], [2.0, 3.0], [0, 0]]),
        "episodes": np.array([[0, 1], [2, 3], [0, 0]]),
    }
    file.append(columns, 2, 1.0)
    file.append(columns, 1, 2.0)
    rows = metrics.read(tmp_path / "metrics.jsonl")
    assert [(r["iteration"], r["steps"], r["seed"], r["episode_return"], r["episodes"]) for r in rows] == [
        (1, 100, 7, 1.5, 0), (1, 100, 8, None, 1), (2, 200, 7, 2, 2), (2, 200, 8, 3, 3), (3, 300, 7, 1.5, 0), (3, 300, 8, None, 1),
    ]  # fmt: skip
    assert "NaN" not in (tmp_path / "metrics.jsonl").read_text()


def test_metrics_continue_behind_the_checkpoint_whatever_followed_it(tmp_path):
    config, path = dg.Config(num_envs=10, num_steps=10), tmp_path / "metrics.jsonl"
    columns = {"episode_return": np.arange(8.0)[:, None]}
    metrics.MetricsFile(path, config, 0).append(columns, 8, 1.5)
    path.write_text(path.read_text() + '{"iteration": 9, "st')  # torn
    file = metrics.MetricsFile(path, config, 5)
    assert (file.iteration, file.seconds) == (5, 1.5)
    file.append(columns, 2, 2.0)
    assert [row["iteration"] for row in metrics.read(path)] == [1, 2, 3, 4, 5, 6, 7]
    steps, returns = file.curve()
    np.testing.assert_array_equal(steps, 100 * np.arange(1, 8))
    np.testing.assert_array_equal(returns[:, 0], [0, 1, 2, 3, 4, 0, 1])
    with pytest.raises(ConfigError, match="must hold the 9 iterations"):
        metrics.MetricsFile(path, config, 9)
    for seconds in ("NaN", "Infinity", "-1", '"inf"', "null"):
        path.write_text(path.read_text().replace('"seconds": 2.0', f'"seconds": {seconds}'))
        before = path.read_bytes()
        with pytest.raises(ConfigError, match="must hold the 7 iterations"):
            metrics.MetricsFile(path, config, 7)
        assert path.read_bytes() == before
        path.write_text(path.read_text().replace(f'"seconds": {seconds}', '"seconds": 2.0'))
