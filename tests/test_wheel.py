"""The package as it is installed: what the wheel has in it, and that it needs nothing of the repository."""

import os
import subprocess
import sys
import zipfile

import pytest

from tests.helpers import ROOT


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, made with the tools that are here where they are, from an index otherwise."""
    out = tmp_path_factory.mktemp("wheel")
    have = (
        subprocess.run([sys.executable, "-c", "import hatchling"], capture_output=True).returncode
        == 0
    )
    program = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        ".",
        "--no-deps",
        "--quiet",
        "--wheel-dir",
        str(out),
    ]
    subprocess.run([*program, *(["--no-build-isolation"] if have else [])], cwd=ROOT, check=True)
    return next(out.glob("dgae_jax-*.whl"))


@pytest.mark.slow
def test_the_wheel_holds_the_package_whole_with_types_data_and_licence_and_nothing_else(wheel):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if not name.endswith("/")}
    package = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "dgae_jax").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {name for name in names if name.startswith("dgae_jax/")} == package
    assert {
        "dgae_jax/__init__.pyi",
        "dgae_jax/py.typed",
        "dgae_jax/report/page.css",
        "dgae_jax/report/published.csv",
    } <= package
    rest = {name.partition("/")[2] for name in names - package}
    assert rest == {"METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE"}


@pytest.mark.slow
def test_installed_it_trains_and_evaluates_exports_and_draws_in_an_empty_directory_without_the_repository(
    wheel, tmp_path
):
    site, place = tmp_path / "site", tmp_path / "place"
    place.mkdir()
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "install",
            "--no-deps",
            "--quiet",
            "--target",
            str(site),
            str(wheel),
        ],
        check=True,
    )
    environment = {**os.environ, "PYTHONPATH": str(site)}

    def run(*words):
        return subprocess.run(
            [sys.executable, *words],
            cwd=place,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    def dgae(*words):
        return run(str(site / "bin" / "dgae"), *words)

    assert run("-c", "import dgae_jax; print(dgae_jax.__file__)").strip() == str(
        site / "dgae_jax" / "__init__.py"
    )
    assert dgae("--version").startswith("dgae_jax ")
    assert "files in run" in dgae(
        "train", "--env", "hopper", "--total-steps", "20000", "--run-dir", "run", "--episodes", "2"
    )
    dgae("evaluate", "run", "--episodes", "2")
    dgae("export", "run", "--to", "npz")
    dgae("figures", "--only", "transport")
    small = (
        "--total-steps",
        "2048",
        "--num-envs",
        "8",
        "--num-steps",
        "16",
        "--policy.minibatches",
        "4",
        "--critic.minibatches",
        "4",
    )
    dgae(
        "reproduce",
        "study",
        "--envs",
        "hopper",
        "--algos",
        "ppo",
        "--seeds",
        "0",
        "--physics",
        "native",
        "--episodes",
        "2",
        *small,
    )
    dgae("report", "study", "--published")
    made = (
        "run/evaluation-gymnasium.json",
        "run/export/npz/policy.npz",
        "figures/transport.png",
        "study/report/report.html",
    )
    assert all((place / name).stat().st_size for name in made)
