"""The help of the commands, as it is read."""

import os
import pty
import re
import shlex
import subprocess
import sys
from importlib import import_module

import pytest

from dgae_jax.cli import main, reproduce, train, tune
from dgae_jax.cli.arguments import parse
from dgae_jax.cli.flags import leaves
from dgae_jax.cli.main import COMMANDS
from dgae_jax.study import sweep
from tests.helpers import ROOT

MODULES = {name: import_module(f"dgae_jax.cli.{name}") for name in COMMANDS}


@pytest.fixture
def dgae(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")

    def dgae(*argv):
        monkeypatch.setattr(sys, "argv", ["dgae", *argv])
        try:
            code = main.main()
        except SystemExit as stop:
            code = stop.code
        return code or 0, *capsys.readouterr()

    return dgae


@pytest.mark.parametrize("name", [None, *COMMANDS])
def test_the_help_fits_eighty_columns_in_plain_characters_and_ends_with_three_examples(name, dgae):
    code, out, err = dgae(*([name] if name else []), "--help")
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    texts = re.sub("[╭╮╰╯│─]", "", out)
    assert texts.isascii()  # a terminal without more shows no escapes
    assert "\x1b" not in out
    assert "None" not in out
    examples = out.partition("\nexamples:\n")[2].splitlines()
    assert [line.strip() for line in examples] == list((MODULES[name] if name else main).EXAMPLES)
    assert len(examples) == 3


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_lists_every_flag_once_with_its_text_and_its_default(name, dgae):
    out = re.sub(r"\s+", " ", re.sub("[│]", "", dgae(name, "--help")[1]))
    for leaf in leaves(MODULES[name].Arguments):
        shown = leaf.flag.upper().replace("-", "_") if leaf.positional else "--" + leaf.flag
        assert leaf.text
        assert out.count(f"{leaf.text} (") >= 1, leaf.flag
        assert re.search(
            rf"{shown}\b[^(]*{re.escape(leaf.text)} \((default: .+?|unset|required)\)", out
        ), leaf.flag


def test_settings_stand_below_headings_with_the_defaults_of_the_algorithm_that_is_named(dgae):
    _, out, _ = dgae("train", "--algo", "trpo", "--help")
    headings = re.findall(r"^[^\w\n]*(?:(\w+) )?options[^\w\n]*$", out, re.MULTILINE)
    assert headings == [
        "",
        "task",
        "noise",
        "algorithm",
        "rollout",
        "policy",
        "critic",
        "run",
        "evaluation",
        "device",
        "diagnostics",
    ]
    words = " ".join(out.split())
    assert "summed over the action's dimensions [nats]. (default: 0.03)" in words
    assert "never exceeded [environment steps]. (default: 1_000_000)" in words


def parsed(name, argv, monkeypatch):
    """All of a command but its work."""
    monkeypatch.setattr(tune, "_storage", lambda url: url)
    if name == "train":
        return train.parsed(argv)
    if name == "tune":
        return tune._tuning(argv)
    if name == "reproduce":
        arguments, rest = reproduce.parse_known(reproduce.Arguments, "", argv, rest=reproduce.REST)
        return reproduce._cells(arguments, rest)
    return parse(MODULES[name].Arguments, "", argv)


@pytest.mark.parametrize(
    "line", [line for module in (main, *MODULES.values()) for line in module.EXAMPLES]
)
def test_an_example_is_a_command_line_that_is_understood(line, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    program, name, *argv = shlex.split(line)
    assert program == "dgae"
    if "--resume" in argv:
        argv[argv.index("--resume")] = "--run-dir"  # there is no such run here
    assert parsed(name, argv, monkeypatch)


def test_help_and_version_load_neither_jax_nor_what_else_takes_seconds():
    code = """
import sys
from dgae_jax.cli.main import main
for argv in (["--help"], ["--version"], *([name, "--help"] for name in sys.argv[1:])):
    sys.argv = ["dgae", *argv]
    try:
        main()
    except SystemExit as stop:
        assert not stop.code
    heavy = [name for name in ("jax", "mujoco", "brax", "flax", "gymnasium", "matplotlib", "optuna") if name in sys.modules]
    assert not heavy, (argv, heavy)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, *COMMANDS], cwd=ROOT, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(
        r"^dgae_jax [\d.]+\nPython [\d.]+, jax [\d.]+, mujoco [\d.]+", done.stdout, re.MULTILINE
    )


@pytest.mark.parametrize(
    ("environment", "colours"),
    [
        ({"TERM": "xterm"}, True),
        ({"TERM": "dumb"}, False),
        ({"TERM": "xterm", "NO_COLOR": "1"}, False),
    ],
)
def test_a_terminal_has_colours_where_it_can_and_may(environment, colours):
    ours, theirs = pty.openpty()
    program = [sys.executable, "-m", "dgae_jax.cli.main", "figures", "--help"]
    variables = {
        **{k: v for k, v in os.environ.items() if k != "NO_COLOR"},
        "COLUMNS": "80",
        **environment,
    }
    subprocess.run(program, cwd=ROOT, stdout=theirs, env=variables, check=True)
    os.close(theirs)
    assert (b"\x1b[" in os.read(ours, 100_000)) == colours


def test_in_ascii_there_is_not_a_box_nor_an_escape():
    program = [sys.executable, "-m", "dgae_jax.cli.main", "train", "--help"]
    done = subprocess.run(
        program,
        cwd=ROOT,
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": "80"},
        check=True,
    )
    out = done.stdout.decode("ascii")
    assert "\\x" not in out
    assert "\\u" not in out
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("train --nun-envs 3", "--nun-envs: is not a flag of this command; perhaps --num-envs (--help lists every flag)"),
        ("train hopper", "hopper: belongs to no flag (--help lists every flag)"),
        ("train --env", "--env: must be followed by a value"),
        ("train --seed=1e400", "--seed 1e400: must be a whole number"),
        ("train --gamma zero", "--gamma zero: must be a number"),
        ("train --policy.hidden 64,64", "--policy.hidden 64,64: must be whole numbers with spaces between them"),
        ("train --diagnostics yes", "--diagnostics yes: takes no value; it is --diagnostics or --no-diagnostics"),
        ("train --tyro-print-completion csh", "--tyro-print-completion: is written dgae --completion SHELL"),
        ("evaluate", "RUN_DIR: must be given"),
        ("evaluate . .", ".: belongs to no flag (--help lists every flag)"),
        ("export .", "--to: must be given"),
        ("export . --to npz pdf", "--to npz pdf: must be one of npz, onnx, gymnasium"),
        ("reproduce x --sedes 1", "--sedes: is not a flag of this command; perhaps --seeds or --seed (--help lists every flag)"),
        ("reproduce x --lr 1", "--lr: is written --policy.learning-rate or --critic.learning-rate"),
        ("reproduce x --seeds 0 -1", "--seeds 0 -1: must be whole numbers from 0 to 4,294,967,295"),
        ("train --config=", "--config: must be followed by a value"),
        ("tune --trails 3", "--trails: is not a flag of this command; perhaps --trials (--help lists every flag)"),
        ("--completion csh", "--completion csh: must be one of bash, zsh, fish"),
        ("--completion", "--completion nothing: must be one of bash, zsh, fish"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_in_our_words(argv, message, dgae, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep, "opened", None)
    assert dgae(*argv.split()) == (2, "", f"error: {message}\n")
    assert list(tmp_path.iterdir()) == []
