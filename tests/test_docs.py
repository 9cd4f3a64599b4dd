"""What the documents print is run as it stands there."""

import json
import re
import shlex

import numpy as np
import pytest

from benchmarks.table import table
from dgae_jax.cli import reproduce
from dgae_jax.cli.arguments import parse_known
from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.parts import COVARIANCES, CRITICS, OPTIMIZERS, TARGETS, UPDATES
from dgae_jax.configs.serial import to_dict
from dgae_jax.maths.risk import METRICS
from dgae_jax.report import markdown, results, tables
from dgae_jax.report.groups import groups_of
from dgae_jax.run import directory
from tests.helpers import ROOT

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TRAINS = re.compile(r"\b(train|train_step|learn)\(")
"""What takes long; the README's are run by default."""

BLOCKS = [
    pytest.param(
        block,
        id=f"{path.name}:{text[: text.index(block)].count(chr(10)) + 1}",
        marks=pytest.mark.slow if TRAINS.search(block) and path.name != "README.md" else (),
    )
    for path in DOCUMENTS
    for text in [path.read_text()]
    for block in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
]


@pytest.mark.parametrize("block", BLOCKS)
def test_a_block_of_code_runs_as_it_is_printed(block, monkeypatch, tmp_path):
    for package in re.findall(r"^# needs (\w+)$", block, re.MULTILINE):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    kept = [
        (table, dict(table))
        for table in (ALGORITHMS, UPDATES, METRICS, COVARIANCES, CRITICS, OPTIMIZERS, TARGETS)
    ]
    try:
        exec(compile(block, "document", "exec"), {"__name__": "document"})
    finally:
        for table, before in kept:
            table.clear()
            table.update(before)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_modules_that_documents_name_exist(path):
    for name in re.findall(
        r"`((?:dgae_jax|experiments|benchmarks|tests|docs)/[\w/]+\.\w+)`", path.read_text()
    ):
        assert (ROOT / name).exists(), name


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_a_table_of_measurements_is_what_its_command_prints(path):
    for file, block in re.findall(
        r"<!-- python benchmarks/table\.py (\S+) -->\n(.*?)\n<!-- -->", path.read_text(), re.DOTALL
    ):
        assert block == table(json.loads((ROOT / file).read_text()))


@pytest.mark.parametrize(
    ("path", "study", "names"),
    [
        ("README.md", "tuned", ["returns"]),
        ("docs/results.md", "tuned", ["returns", "improvement", "reach"]),
        ("docs/results.md", "long", ["returns", "improvement"]),
        ("docs/results.md", "swimmer-099", ["returns"]),
        ("docs/decisions.md", "ant-lambda-095", ["returns"]),
        ("docs/decisions.md", "hopper-gamma-099", ["returns"]),
        ("docs/decisions.md", "swimmer-lambda-098", ["returns"]),
        ("docs/decisions.md", "ordered", ["returns"]),
        ("docs/decisions.md", "ordered-again", ["returns"]),
        ("docs/reproduction.md", "paper", ["returns", "improvement"]),
        ("docs/reproduction.md", "paper-one-step", ["returns"]),
        ("docs/attribution.md", "attribution", ["attribution", "attribution-over-tasks"]),
        ("docs/attribution.md", "attribution-hopper", ["attribution", "attribution-over-tasks"]),
        ("docs/risk.md", "risk", ["risk"]),
    ],
)
def test_the_tables_of_results_are_what_the_report_says(path, study, names, tmp_path):
    document = tmp_path / "document.md"
    document.write_bytes((ROOT / path).read_bytes())
    assert (
        markdown.replace(document, groups_of(results.read(ROOT / "results" / study).rows), study)
        == names
    )
    assert document.read_bytes() == (ROOT / path).read_bytes()


SHARES = ("0.1", "0.03", "0.01", "0.003")
"""Of W₁, at most which |d| makes means similar."""


def of_critics(study):
    """What the calibration of a study says of its critics: the rates of similar means by SHARES, and each critic's coverage."""
    seeds = json.loads((ROOT / "results" / study / "calibration.json").read_text()).values()
    return [np.mean([one["similar_means"][share] for one in seeds]) for share in SHARES], [
        one["coverage_90"] for one in seeds
    ]


def test_the_rate_of_similar_means_is_the_mean_of_the_seeds_in_the_file_and_the_papers_at_the_threshold_that_is_named():
    rates, _ = of_critics("attribution")
    text = (ROOT / "docs" / "attribution.md").read_text()
    assert f"| c | {' | '.join(SHARES)} |" in text
    assert f"| steps | {' | '.join(f'{100 * rate:.2f} %' for rate in rates)} |" in text
    assert (
        round(float(np.interp(0.00093, rates[::-1], [float(share) for share in SHARES[::-1]])), 3)
        == 0.005
    )


def test_the_critics_with_settings_that_suit_hopper_hold_and_differ_as_their_file_says():
    rates, held = of_critics("attribution-hopper")
    text = (ROOT / "docs" / "attribution.md").read_text()
    *most, last = (f"{100 * rate:.2f} %" for rate in rates)
    assert f"{', '.join(most)} and {last} (`results/attribution-hopper/calibration.json`" in text
    assert f"hold {' · '.join(f'{100 * share:.0f}' for share in held)} % of the returns" in text


def test_the_coverage_of_critics_with_monte_carlo_targets_is_what_the_files_say():
    study, text = ROOT / "results" / "calibration", (ROOT / "docs" / "decisions.md").read_text()
    returns = {row.cell: row.final for row in results.read(study).rows}
    for run, statistics in json.loads((study / "calibration.json").read_text()).items():
        assert (
            f"| `{run}` | {returns[run]:,.0f} | {100 * statistics['coverage_90']:.0f} % |" in text
        )


def test_the_coverage_of_the_critics_of_the_preset_on_hopper_is_what_the_file_says():
    held = json.loads((ROOT / "results" / "tuned" / "calibration.json").read_text())
    cells = " · ".join(
        f"{100 * held[f'hopper-dppo-{seed}']['coverage_90']:.0f}" for seed in range(5)
    )
    assert (
        f"{cells} % of the returns in their central 90 %"
        in (ROOT / "docs" / "decisions.md").read_text()
    )


@pytest.mark.parametrize("study", ["ordered", "ordered-again"])
def test_the_coverage_of_ordered_quantiles_is_what_the_file_says(study):
    held = json.loads((ROOT / "results" / study / "calibration.json").read_text())
    tasks = [
        [held.get(f"{task}-dppo-{seed}") for seed in range(5)]
        for task in ("ant", "hopper", "walker2d")
    ]
    cells = [
        " · ".join(f"{100 * found['coverage_90']:.0f}" for found in seeds if found) or "–"
        for seeds in tasks
    ]
    assert (
        f"| `results/{study}` | {' | '.join(cells)} |"
        in (ROOT / "docs" / "decisions.md").read_text()
    )


def test_what_ordered_quantiles_cost_is_what_five_studies_say():
    names = ("tuned", "ant-lambda-095", "hopper-gamma-099", "ordered", "ordered-again")
    rows = [
        row
        for name in names
        for row in results.read(ROOT / "results" / name).rows
        if row.algo == "dppo"
    ]
    rows = [
        row for row in rows if (row.config["gamma"], row.config["lam"]) == (0.99, 0.95)
    ]  # as `ordered-again` has them
    assert (
        tables.markdown(tables.attribution(groups_of(rows)))
        in (ROOT / "docs" / "decisions.md").read_text()
    )


def test_distributions_that_are_fitted_to_finished_policies_hold_what_the_documents_say():
    rows = json.loads((ROOT / "benchmarks" / "results" / "refit.json").read_text())["rows"]
    held = [100 * row["coverage_90"] for row in rows]
    assert (
        f"all {len(rows)} hold between {min(held):.0f} and {max(held):.0f} %"
        in (ROOT / "docs" / "decisions.md").read_text()
    )
    assert not any(row["crossing"] for row in rows)
    finals = {
        f"{row.cell}.msgpack": row.final for row in results.read(ROOT / "results" / "tuned").rows
    }
    assert {row["checkpoint"]: row["return"] for row in rows}.items() <= finals.items()


def test_the_returns_below_the_film_are_those_of_the_policies_in_it():
    finals = {row.cell: row.final for row in results.read(ROOT / "results" / "tuned").rows}
    shown = re.findall(
        r"dgae refit results/tuned/policies/([\w-]+)\.msgpack",
        (ROOT / "docs" / "results.md").read_text(),
    )
    *most, last = (f"{finals[cell]:,.0f}" for cell in shown)
    assert f"return {', '.join(most)} and {last} on average" in (ROOT / "README.md").read_text()


def test_a_committed_policy_is_there_for_every_result_and_knows_its_configuration():
    for row in results.read(ROOT / "results" / "tuned").rows:
        config = to_dict(
            directory.config_of(ROOT / "results" / "tuned" / "policies" / f"{row.cell}.msgpack")
        )
        assert json.loads(json.dumps(config)) == row.config


@pytest.mark.parametrize(
    "study", sorted((ROOT / "results").iterdir()), ids=lambda study: study.name
)
def test_a_committed_result_names_a_command_that_writes_into_the_results(study):
    rows = [
        json.loads(line)["command"] for line in (study / "results.jsonl").read_text().splitlines()
    ]
    cells = json.loads((study / "study.json").read_text())["commands"].values()
    assert all(command.startswith("dgae reproduce results/") for command in [*rows, *cells])


@pytest.mark.parametrize(
    "study", sorted((ROOT / "results").iterdir()), ids=lambda study: study.name
)
def test_the_commands_that_documents_give_for_a_study_make_the_configurations_of_its_rows(study):
    made = {}
    for command in re.findall(
        rf"dgae reproduce (results/{study.name} [^`\n]+)",
        "\n".join(path.read_text() for path in DOCUMENTS),
    ):
        arguments, rest = parse_known(
            reproduce.Arguments, "", shlex.split(command, comments=True), rest=reproduce.REST
        )
        made |= {
            cell.name: json.loads(json.dumps(to_dict(cell.config)))
            for cell in reproduce._cells(arguments, rest)[0]
        }
    rows = results.read(study).rows
    assert {row.cell: made.get(row.cell) for row in rows} == {row.cell: row.config for row in rows}
