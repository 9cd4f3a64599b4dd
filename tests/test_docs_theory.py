"""The table of docs/theory.md against the code, the docstrings, and the source of the paper."""

import inspect
import pkgutil
import re
from pathlib import Path

import pytest

import dgae_jax
from tests.helpers import ROOT

PAPER = ROOT.parent / "shared" / "paper" / "dgae.tex"
TEXT = (ROOT / "docs" / "theory.md").read_text()
ROWS = [line.strip("|").split("|") for line in TEXT.splitlines() if line.startswith("| ")][1:]
LABELS = [label for row in ROWS for label in re.findall(r"`(\w+:\w+)`", row[1])]
PAIRS = [
    (name, re.findall(r":(\w+)`", row[1]))
    for row in ROWS
    for name in re.findall(r"`([\w.]+)`", row[2])
]
SOURCES = {
    path: path.read_text()
    for room in ("maths", "learn")
    for path in sorted(Path(dgae_jax.__path__[0], room).glob("*.py"))
}


def paper():
    if not PAPER.exists():
        pytest.skip(f"the source of the paper is not at {PAPER}")
    return PAPER.read_text()


@pytest.mark.parametrize(("name", "labels"), PAIRS)
def test_each_name_of_the_table_exists_and_its_docstring_cites_the_label(name, labels):
    function = pkgutil.resolve_name(f"dgae_jax.{name}")
    assert any(label in inspect.getdoc(function) for label in labels)


def test_each_label_of_the_table_is_in_the_paper():
    source = paper()
    assert [label for label in LABELS if rf"\label{{{label}}}" not in source] == []


def test_each_labelled_statement_of_the_paper_is_in_the_table():
    labels = re.findall(r"\\label\{((?:eq|def|lem|alg):\w+)\}", paper())
    assert sorted(labels) == sorted(label for label in LABELS if not label.startswith("sec:"))


def test_each_label_that_a_docstring_cites_is_in_the_table():
    citation = re.compile(r"\b(?:Eq|Def|Prop|Lemma|Algorithm)\.? (\w+_\w+|GAE|lemma1)\b")
    cited = {label for text in SOURCES.values() for label in citation.findall(text)}
    assert cited <= {label.split(":")[1] for label in LABELS}
    assert {"gae_final", "k_step_estimator", "quantile_huber_loss", "policy_value_update"} <= cited
