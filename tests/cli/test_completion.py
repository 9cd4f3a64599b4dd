"""Completion in a shell, in a real one."""

import shutil
import subprocess

import pytest

from dgae_jax.cli import completion, main
from dgae_jax.cli.flags import leaves
from dgae_jax.cli.mistakes import names
from dgae_jax.cli.train import Arguments


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    """What bash offers for the last word of a command line, in a directory with a run."""
    place = tmp_path_factory.mktemp("completion")
    (place / "my run").mkdir()
    (place / "dgae.bash").write_text(completion.script("bash", main.COMMANDS))
    program = 'source dgae.bash; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _dgae; printf "%s\\n" "${COMPREPLY[@]}"'

    def complete(*words):
        done = subprocess.run(
            ["bash", "-c", program, "bash", *words],
            cwd=place,
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stderr == ""
        return done.stdout.splitlines()

    return complete


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash")
def test_bash_completes_commands_flags_names_and_files(complete):
    assert set(main.COMMANDS) <= set(complete("dgae", ""))
    assert complete("dgae", "ev") == ["evaluate"]
    assert complete("dgae", "train", "--algo", "d") == ["dppo", "dtrpo", "da2c"]
    assert complete("dgae", "train", "--physics", "mjx-") == ["mjx-warp"]
    assert complete("dgae", "export", "x", "--to", "npz", "o") == ["onnx"]
    assert complete("dgae", "reproduce", "x", "--algos", "ppo", "tr") == ["trpo"]
    assert complete("dgae", "tune", "--critic.ta") == ["--critic.target"]  # a flag of dgae train
    assert complete("dgae", "evaluate", "my") == ["my run"]
    assert complete("dgae", "train", "--run-dir", "my") == ["my run"]
    assert set(complete("dgae", "train", "--")) == set(names(list(leaves(Arguments))))


@pytest.mark.parametrize(("shell", "check"), [("zsh", ["zsh", "-n"]), ("fish", ["fish", "-n"])])
def test_the_scripts_of_other_shells_are_of_their_language_and_know_all_commands(
    shell, check, tmp_path
):
    text = completion.script(shell, main.COMMANDS)
    assert all(f"'{name}'" in text for name in main.COMMANDS)
    (tmp_path / "dgae").write_text(text)
    if shutil.which(shell):
        subprocess.run([*check, str(tmp_path / "dgae")], check=True)


@pytest.mark.parametrize("setting", completion.NAMES)
def test_names_that_are_offered_are_of_flags_that_exist(setting):
    everything = [
        leaf for cls in (completion.leaves_of(name) for name in main.COMMANDS) for leaf in cls
    ]
    assert setting.replace("_", "-") in {leaf.flag for leaf in everything}
