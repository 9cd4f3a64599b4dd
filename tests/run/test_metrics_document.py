"""docs/metrics.md explains what a run writes: every number, and nothing else."""

import dataclasses
import re

import pytest

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.resolved import resolve
from dgae_jax.run import metrics
from dgae_jax.run.training import train_command
from tests.helpers import ROOT
from tests.runs import QUIET, small

TEXT = (ROOT / "docs" / "metrics.md").read_text()


def table(title):
    """Cells of the rows of the first table below a heading, by the name in the first."""
    lines = TEXT.split(f"## {title}\n")[1].split("\n## ")[0].splitlines()
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines if line.startswith("| `")]
    return {row[0].strip().strip("`"): [cell.strip() for cell in row[1:]] for row in rows}


METRICS, EVALUATIONS = table("metrics.jsonl"), table("evaluations.jsonl")


@pytest.fixture(
    scope="module",
    params=[
        name if name in ("dppo", "dtrpo", "a2c") else pytest.param(name, marks=pytest.mark.slow)
        for name in ALGORITHMS
    ],
)
def run(request, tmp_path_factory):
    """The configuration of a tiny run with all that it can say, its metrics and its evaluations."""
    config = small(request.param)
    shape = {
        "total_steps": 2 * config.samples_per_iteration,
        "diagnostics": config.critic.kind == "quantile",
    }
    config = resolve(dataclasses.replace(config, **shape))
    run_dir = tmp_path_factory.mktemp("runs") / "run"
    assert train_command(config, dataclasses.replace(QUIET, run_dir=run_dir)) == 0
    return (
        config,
        metrics.read(run_dir / "metrics.jsonl"),
        metrics.read(run_dir / "evaluations.jsonl"),
    )


def test_the_document_names_exactly_the_metrics_of_each_algorithm(run):
    config, rows, _ = run
    kinds = {"all", config.policy.update} | ({"diagnostics"} if config.diagnostics else set())
    assert rows
    for row in rows:
        assert set(row) == {
            name for name, (where, *_) in METRICS.items() if kinds & set(where.split(", "))
        }


def test_the_document_names_exactly_the_numbers_of_an_evaluation(run):
    _, _, rows = run
    assert rows
    for row in rows:
        assert set(row) == set(EVALUATIONS)


def test_every_metric_is_in_some_algorithm_and_has_a_unit_a_meaning_and_what_is_healthy():
    known = {"all", "diagnostics", *(row.policy_update for row in ALGORITHMS.values())}
    for name, (where, *said) in METRICS.items():
        assert set(where.split(", ")) <= known, name
        assert len(said) == 3, name
        assert all(said), name


def test_the_picture_has_a_source_of_at_most_200_rows_with_the_metrics_of_the_document():
    rows = metrics.read(ROOT / "docs" / "images" / "metrics.jsonl")
    assert 100 < len(rows) <= 200
    assert all(set(row) <= set(METRICS) for row in rows)
    assert (ROOT / "docs" / "images" / "metrics.png").exists()
