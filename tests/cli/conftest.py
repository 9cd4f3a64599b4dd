import subprocess
import sys

import pytest

from dgae_jax.cli import main
from tests.helpers import ROOT, TINY


@pytest.fixture
def dgae(monkeypatch, capsys):
    """`dgae …` in this process: exit code, stdout, stderr."""
    monkeypatch.setenv("COLUMNS", "80")

    def dgae(*argv):
        monkeypatch.setattr(sys, "argv", ["dgae", *map(str, argv)])
        try:
            code = main.main()
        except SystemExit as stop:
            code = stop.code
        return code or 0, *capsys.readouterr()

    return dgae


@pytest.fixture(scope="package")
def trained(tmp_path_factory):
    """A finished tiny run: its directory, the lines that it printed, and stderr."""
    run_dir = tmp_path_factory.mktemp("runs") / "tiny"
    argv = ["--total-steps", "1e3", "--run-dir", str(run_dir), "--episodes", "3", *TINY]
    done = subprocess.run(
        [sys.executable, "experiments/train.py", *argv, "--checkpoint-every", "300"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    return run_dir, done.stdout.splitlines(), done.stderr
