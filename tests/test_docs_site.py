"""The documents against each other and against the code: links, commands, settings, public names, other trainers' names."""

import ast
import functools
import importlib
import re
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import dgae_jax
from dgae_jax.cli import train
from dgae_jax.cli.main import COMMANDS
from dgae_jax.cli.spelling import ELSEWHERE, FLAGS
from dgae_jax.configs.config import ConfigError
from docs.site import configuration
from tests.helpers import ROOT

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
EACH = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
COMMAND = re.compile(
    r"(?:^ {4,}|`|\$\()((?:dgae |python experiments/)[a-z]+(?:\.py)?(?:\\\n|[^`\n])*)", re.MULTILINE
)


def prose(path):
    """The text of a document without its blocks of code."""
    return re.sub(r"^```.*?^```", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(path):
    """The names that GitHub gives the headings of a document."""
    headings = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }


def commands(path):
    """Name and words of each command line in a document."""
    for line in COMMAND.findall(path.read_text()):
        words = [
            word
            for word in shlex.split(line.replace("\\\n", " ").replace("…", ""), comments=True)
            if word
        ]
        yield (words[1], words[2:]) if words[0] == "dgae" else (Path(words[1]).stem, words[2:])


@functools.cache
def flags(name):
    """The flags that a command's help lists; those of `train` may follow where a command takes them."""
    with pytest.MonkeyPatch.context() as patch:
        said = []
        patch.setattr(sys, "argv", ["dgae", "--help"])
        patch.setattr(sys.stdout, "write", said.append)
        with pytest.raises(SystemExit):
            importlib.import_module(f"dgae_jax.cli.{name}").main()
    own = set(re.findall(r"--[\w.-]+", re.sub(r"\x1b\[[\d;]*m", "", "".join(said))))
    return own | flags("train") if name in ("reproduce", "tune") else own


@EACH
def test_links_lead_to_a_file_and_a_heading_of_it(path):
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", prose(path)):
        name, _, anchor = target.partition("#")
        file = path.parent / name if name else path
        assert file.exists(), target
        assert path.parent != ROOT / "docs" or not name.startswith(".."), (
            f"{target} is not in the site"
        )
        assert not anchor or anchor in anchors(file), target


def test_the_documents_have_links_with_headings_and_commands_with_flags():
    assert sum(prose(path).count(".md#") for path in DOCUMENTS) > 20
    assert sum(len(words) > 2 for path in DOCUMENTS for _, words in commands(path)) > 20


@EACH
def test_command_lines_have_flags_that_exist(path):
    for name, words in commands(path):
        assert name in COMMANDS
        given = [
            word.partition("=")[0] for word in words if word.startswith("--") and word != "--help"
        ]
        assert not [word for word in given if word not in flags(name)], (name, words)


@EACH
def test_command_lines_of_train_mean_a_valid_configuration(path):
    for name, words in commands(path):
        if name == "train" and not {"--help", "--resume", "--config"} & set(words):
            try:
                train.parsed(words)
            except ConfigError as mistake:
                if "pip install" not in str(mistake):  # for an extra that is not here
                    pytest.fail(f"{words}: {mistake}")


def test_the_page_of_settings_is_what_the_dataclasses_say():
    assert configuration.PAGE.read_text() == configuration.page()


def test_the_page_of_the_interface_has_every_public_name_once():
    names = re.findall(
        r"^::: dgae_jax\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE
    )
    assert sorted(names) == sorted(dgae_jax.__all__)


def settings_elsewhere():
    """Cells of the table of settings of other trainers, without its head."""
    section = (
        (ROOT / "docs" / "coming-from.md")
        .read_text()
        .split("## Settings of PPO\n")[1]
        .split("\n## ")[0]
    )
    return [
        [cell.strip() for cell in row.strip("|").split("|")]
        for row in section.splitlines()
        if row.startswith("| ")
    ][1:]


def names_in(cell):
    return re.findall(r"`([\w.-]+)`", cell)


def test_flags_of_the_table_of_other_trainers_exist_and_the_command_line_answers_their_names_with_them():
    answered = 0
    for ours, *theirs in settings_elsewhere():
        here = [name.removeprefix("--") for name in names_in(ours)]
        assert set(here) <= set(FLAGS)
        for name in (name.replace("_", "-") for cell in theirs for name in names_in(cell)):
            if here and name in ELSEWHERE:
                answered += 1
                assert ELSEWHERE[name] in {each.rpartition(".")[2] for each in here}
    assert answered > 15


SB3 = [
    "ppo/ppo.py",
    "common/policies.py",
    "common/env_util.py",
    "common/vec_env/vec_normalize.py",
    "common/base_class.py",
]
REJAX = ["algos/algorithm.py", "algos/mixins.py", "algos/ppo.py"]


@pytest.mark.parametrize(("column", "package", "files"), [
    (2, "stable_baselines3", SB3), (3, "brax", ["training/agents/ppo/train.py"]), (4, "rejax", REJAX),
])  # fmt: skip
def test_names_of_the_table_of_other_trainers_are_in_their_sources(column, package, files):
    if find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    folder = Path(find_spec(package).origin).parent
    trees = [ast.parse((folder / file).read_text()) for file in files]
    known = {
        getattr(node, field)
        for tree in trees
        for node in ast.walk(tree)
        for field in ("arg", "attr", "id", "name")
        if hasattr(node, field)
    }
    words = {
        node.value for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant)
    }
    names = {
        name
        for row in settings_elsewhere()
        for name in names_in(row[column])
        if name not in ("TimeLimit", "VecNormalize")
    }
    assert len(names) > 10
    assert names <= known | words
