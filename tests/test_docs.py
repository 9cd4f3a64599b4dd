"""The documents against the code and the files: blocks run, links resolve, tables are generated."""

import contextlib
import dataclasses
import inspect
import json
import os
import pkgutil
import re
import shlex
from functools import partial
from pathlib import Path
from unittest.mock import patch

import pytest

import dgae_jax
from benchmarks.table import table
from dgae_jax.cli import parse, reproduce, train
from dgae_jax.cli.main import COMMANDS, command
from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.serial import SCHEMA, to_dict
from dgae_jax.learn.build import TABLES
from dgae_jax.maths.risk import METRICS
from dgae_jax.report import results, tables
from dgae_jax.report.groups import groups_of
from dgae_jax.run import directory, metrics
from dgae_jax.run.training import train_command
from docs.site import configuration
from tests.helpers import ROOT
from tests.runs import QUIET, small

DOCUMENTS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = {path: path.read_text() for path in DOCUMENTS}
STUDIES = [path.name for path in sorted((ROOT / "results").iterdir())]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
SLOW = re.compile(r"\b(train|learn)\(|takes minutes")
BLOCKS = [
    pytest.param(block[2], id=f"{path.name}:{number}", marks=[pytest.mark.slow] * slow)
    for path, text in TEXTS.items()
    for number, block in enumerate(FENCE.finditer(text), 1)
    for slow in [bool(SLOW.search(block[2]))]
    if block[1] == "python"
]


def prose(path):
    return FENCE.sub("", TEXTS[path])


def anchors(path):
    headings = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).strip().replace(" ", "-") for line in headings}


def command_lines():
    """Yield name and words of each command line in the documents and the help."""
    texts = [text for path, text in TEXTS.items() if path.name != "CHANGELOG.md"]
    texts += [command(name).arguments.__doc__ for name in COMMANDS]
    pattern = r"(?:^ {4,}|^|`|&& )dgae ([a-z]+)((?:\\\n|[^`\n&;)])*)"
    for name, rest in re.findall(pattern, "\n".join(texts), re.MULTILINE):
        words = shlex.split(rest.replace("\\\n", " "), comments=True)
        if name in COMMANDS and words:
            yield name, words


@pytest.mark.parametrize("block", BLOCKS)
def test_code_blocks_run(block, monkeypatch, tmp_path):
    for package in re.findall(r"^# needs (\w+)$", block, re.MULTILINE):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    tables = [ALGORITHMS, METRICS, *(each for pair in TABLES.values() for each in pair)]
    with contextlib.ExitStack() as stack:
        for each in tables:
            stack.enter_context(patch.dict(each))
        exec(compile(block, "document", "exec"), {"__name__": "document"})


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_links_resolve_and_named_files_exist(path):
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", prose(path)):
        name, _, anchor = target.partition("#")
        file = Path(os.path.normpath(path.parent / name)) if name else path
        assert file.exists(), target
        assert path.parent == ROOT or (ROOT / "docs") in file.parents, f"{target} leaves the site"
        assert not anchor or anchor in anchors(file), target
    names = r"`((?:dgae_jax|examples|experiments|benchmarks|tests|docs|results)/[\w/.-]+\.\w+)`"
    for name in re.findall(names, TEXTS[path]):
        assert (ROOT / name).exists(), name


@pytest.mark.parametrize("path", (ROOT / "notebooks").glob("*.ipynb"), ids=lambda path: path.stem)
def test_notebooks_have_outputs_without_errors(path):
    cells = json.loads(path.read_text())["cells"]
    outputs = [each for cell in cells for each in cell.get("outputs", ())]
    assert outputs
    assert not [each for each in outputs if "traceback" in each]
    assert path.stat().st_size < 300_000


@pytest.mark.parametrize("study", STUDIES)
def test_report_tables_equal_the_results(study, tmp_path):
    groups = groups_of(results.read(ROOT / "results" / study).rows)
    for path, text in TEXTS.items():
        mine = re.search(rf"<!-- dgae report: [\w-]+ of {study} -->", text)
        if mine or (study == "tuned" and path.name == "README.md"):
            copy = tmp_path / path.name
            copy.write_text(text)
            tables.replace(copy, groups, study)
            assert copy.read_text() == text


def test_benchmark_tables_equal_their_files():
    pattern = r"<!-- python benchmarks/table\.py (\S+) -->\n(.*?)\n<!-- -->"
    found = [pair for text in TEXTS.values() for pair in re.findall(pattern, text, re.DOTALL)]
    assert found
    for file, block in found:
        assert block == table(json.loads((ROOT / file).read_text())), file


@pytest.mark.parametrize(("name", "words"), list(command_lines()), ids=str)
def test_commands_parse(name, words):
    if {"--help", "--resume"} & set(words):
        return
    read = train.parsed if name == "train" else partial(parse.arguments, command(name).arguments)
    try:
        read(words)
    except ConfigError as mistake:
        if "pip install" not in str(mistake):  # an extra that is not here
            raise


@pytest.mark.parametrize("study", STUDIES)
def test_commands_make_the_configurations_of_the_results(study):
    made = {}
    for name, words in command_lines():
        if name == "reproduce" and words[0] == f"results/{study}":
            made |= {run: to_dict(config) for run, config in reproduce.parsed(words)[1].items()}
    rows = results.read(ROOT / "results" / study).rows
    expected = {row.run: row.config | {"schema": SCHEMA} for row in rows}
    assert {name: json.loads(json.dumps(made.get(name))) for name in expected} == expected


def test_committed_policies_know_their_configuration():
    for row in results.read(ROOT / "results" / "tuned").rows:
        policy = ROOT / "results" / "tuned" / "policies" / f"{row.run}.msgpack"
        config = row.config | {"schema": SCHEMA}
        assert json.loads(json.dumps(to_dict(directory.config_of(policy)))) == config


def test_configuration_page_equals_the_dataclasses():
    assert configuration.PAGE.read_text() == configuration.page()


def test_api_page_has_every_public_name_once():
    names = re.findall(r"^::: dgae_jax\.(\w+)$", TEXTS[ROOT / "docs" / "api.md"], re.MULTILINE)
    assert sorted(names) == sorted(dgae_jax.__all__)


@pytest.mark.parametrize(
    "algo", [pytest.param(a, marks=[pytest.mark.slow] * (a != "dppo")) for a in ALGORITHMS]
)
def test_every_metric_is_documented(algo, tmp_path):
    config = small(algo).as_config().replace(diagnostics=algo.startswith("d"))
    config = dgae_jax.resolve(config.replace(total_steps=2 * config.samples_per_iteration))
    options = dataclasses.replace(QUIET, run_dir=tmp_path / "run")
    assert train_command(config, options) == 0
    table = TEXTS[ROOT / "docs" / "algorithms.md"].split("## Metrics\n")[1]
    documented = set(re.findall(r"`([\w/]+)`", table))
    for row in metrics.read(tmp_path / "run" / "metrics.jsonl"):
        assert set(row) <= documented


THEORY = TEXTS[ROOT / "docs" / "theory.md"].split("\n## ")[0]
ROWS = [line.strip("|").split("|") for line in THEORY.splitlines() if line.startswith("| ")][1:]


@pytest.mark.parametrize(
    ("name", "labels"),
    [(n, re.findall(r":(\w+)`", r[1])) for r in ROWS for n in re.findall(r"`([\w.]+)`", r[2])],
)
def test_docstrings_cite_the_equations_of_the_theory_page(name, labels):
    function = pkgutil.resolve_name(f"dgae_jax.{name}")
    assert any(label in (inspect.getdoc(function) or "") for label in labels)
