"""Published results, and where we depart from the paper."""

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.envs.registry import TASKS
from dgae_jax.report import deviations, published


def test_the_file_of_the_repository_has_results_of_every_task():
    rows = published.read()
    assert {row.task for row in rows} == set(TASKS)
    assert (
        published.Published("walker2d", 1_000_000, "TRPO", 4502.0, 234.0, 3, "SB3-contrib, v3")
        in rows
    )
    assert published.Published("swimmer", 4_000_000, "PPO", 282.0, None, None, "SLM-Lab") in rows


def test_a_file_that_is_missing_or_misshapen_is_refused_in_one_line(tmp_path):
    with pytest.raises(
        ConfigError, match=r"^published: needs .*/none.csv \(No such file or directory\)"
    ):
        published.read(tmp_path / "none.csv")
    for text in (
        "task,samples\nant,1\n",
        "task,samples,algorithm,mean,spread,seeds,source\nant,x,PPO,1,,,y\n",
    ):
        (tmp_path / "bad.csv").write_text(text)
        with pytest.raises(
            ConfigError,
            match="must have the columns task, samples, algorithm, mean, spread, seeds, source",
        ):
            published.read(tmp_path / "bad.csv")


def test_deviations_are_the_numbered_list_of_the_document_or_a_short_one(tmp_path):
    path = tmp_path / "reproduction.md"
    assert deviations.deviations(path) == list(deviations.SHORT)
    path.write_text("# Title\n\ntext\n\n1. One\n   goes on.\n2. `Two`.\n\nNo item.\n")
    assert deviations.deviations(path) == ["One goes on.", "`Two`."]
    path.write_text("| a | table |\n")
    assert deviations.deviations(path) == list(deviations.SHORT)
