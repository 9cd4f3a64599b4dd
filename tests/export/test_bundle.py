"""Exported policies do outside what they do here, and `dgae export` writes them."""

import dataclasses
import json
import shutil
import subprocess
import sys
import tomllib
from functools import partial

import jax
import numpy as np
import onnx
import onnxruntime
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.cli.main import command
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.export import arrays, bundle
from dgae_jax.export.templates.policy import Policy
from dgae_jax.run import checkpoint
from dgae_jax.run.directory import read_config
from dgae_jax.run.evaluation import evaluate_policies
from tests.export.conftest import make_untrained
from tests.helpers import ROOT
from tests.runs import last, small

FORMATS = ("npz", "onnx", "gymnasium")
QUANTILES = {"quantile": 8, "scalar": 1, "ordered": 8, "sorted": 8}


@pytest.fixture(scope="module")
def exported(untrained, tmp_path_factory):
    """The policy, observations beyond the normalizer's limit, and the directory of its exports."""
    directory = tmp_path_factory.mktemp("exported")
    bundle.export(untrained.file, untrained.config, "latest", untrained.index, FORMATS, directory)
    noise = np.random.default_rng(1).normal(size=(1000, 11))
    return untrained, (8 * noise).astype(np.float32), directory


def assert_same(actions, quantiles, exported):
    untrained, obs, _ = exported
    policy = untrained.policy
    assert quantiles.shape == (1000, QUANTILES[untrained.name])
    assert (actions.dtype, quantiles.dtype) == (np.float32, np.float32)
    assert 0.05 < (np.abs(policy(obs)) == 1).mean() < 0.95
    assert_allclose(actions, policy(obs), rtol=1e-5, atol=1e-5)
    assert_allclose(quantiles, policy.quantiles(obs), rtol=1e-5, atol=1e-5)
    assert np.ptp(quantiles) > 0.1


def run_outside(directory, *argv):
    """Run a program in a Python that has neither JAX nor this package."""
    program = (
        "import sys, runpy; sys.path.insert(0, '');"
        "sys.modules.update(jax=None, jaxlib=None, flax=None, dgae_jax=None);"
        f"sys.argv = {list(argv)!r}; runpy.run_path({argv[0]!r}, run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=directory, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_numpy_computes_the_policy(exported):
    _, obs, directory = exported
    policy = Policy(directory / "npz" / "policy.npz")
    assert_same(policy(obs), policy.quantiles(obs), exported)
    assert_allclose(policy(obs[0]), policy(obs)[0], atol=1e-6)


def test_onnx_runtime_computes_the_policy_for_any_batch(exported):
    _, obs, directory = exported
    file = str(directory / "onnx" / "policy.onnx")
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    run = partial(session.run, ["action", "quantiles"])
    assert_same(*run({"obs": obs}), exported)
    assert [x.shape[0] for x in run({"obs": obs[:1]})] == [1, 1]
    (taken,) = session.get_inputs()
    assert (taken.name, taken.type, taken.shape) == ("obs", "tensor(float)", ["batch", 11])


def test_agent_plays_the_episodes_of_an_evaluation(exported):
    untrained, _, directory = exported
    out = run_outside(directory / "gymnasium", "agent.py", "--episodes", "4", "--seed", "3")
    *lines, summary = out.splitlines()
    played = [float(line.split()[-1]) for line in lines]
    result = evaluate_policies(
        untrained.networks.policy, untrained.config, engine="gymnasium", episodes=4, seed=3
    )
    assert len(set(played)) == 4
    assert_allclose(played, result["seeds"][untrained.index]["returns"], rtol=1e-3)
    assert float(summary.split()[1].rstrip(",")) == pytest.approx(np.mean(played), abs=1e-3)


def test_custom_networks_are_refused(trained):
    config = read_config(trained)
    found = checkpoint.load_networks(trained, config, "latest")
    renamed = found.policy._replace(params={"params": {"Body": found.policy.params["params"]}})
    with pytest.raises(ConfigError, match="'kernel'"):
        arrays.arrays_of(found._replace(policy=renamed), config, 0)
    shifted = jax.tree.map(lambda x: x + 1, found.critic.obs_stats)
    other = found._replace(critic=found.critic._replace(obs_stats=shifted))
    with pytest.raises(ConfigError, match="quantiles differ"):
        arrays.arrays_of(other, config, 0)


@pytest.fixture(scope="module")
def cards(trained, tmp_path_factory):
    directory = tmp_path_factory.mktemp("cards")
    bundle.export(trained, read_config(trained), "best", 1, FORMATS, directory)
    return directory


def test_programs_on_the_cards_run(cards):
    for kind in ("npz", "onnx"):
        block = (cards / kind / "README.md").read_text().split("```python\n")[1].split("```")[0]
        (cards / kind / "use.py").write_text(block + "print(actions.shape, quantiles.shape)")
        assert run_outside(cards / kind, "use.py") == "(5, 3) (5, 8)\n"


def test_card_and_model_show_the_facts_of_the_run(trained, cards):
    manifest = json.loads((trained / "manifest.json").read_text())
    rows = [json.loads(line) for line in (trained / "evaluations.jsonl").read_text().splitlines()]
    means = {
        steps: np.mean([row["return_mean"] for row in rows if row["steps"] == steps])
        for steps in (256, 512)
    }
    best = max(means, key=lambda steps: (means[steps], steps))
    (mean,) = (row["return_mean"] for row in rows if (row["steps"], row["seed"]) == (best, 1))
    text = (cards / "npz" / "README.md").read_text()
    for fact in (
        "| task | Hopper-v4, episodes of at most 20 steps, observations [11], actions [3] |\n",
        "| algorithm | dppo |\n",
        "| trained on | hopper-v4, engine native, seed 1 |\n",
        f"| samples | {best} |\n",
        f"{mean:,.1f} ± 0.0 over 1 episode, mean ± standard deviation, episodes which chose this",
        "| critic | quantile [8], of the discounted return (γ = 0.99) of rewards divided",
        f"| checkpoint | steps_{best:012d}.msgpack |\n",
        f"jax {manifest['versions']['jax']}",
    ):
        assert fact in text
    model = onnx.load(cards / "onnx" / "policy.onnx")
    about = {each.key: each.value for each in model.metadata_props}
    revision = {"git_revision": manifest["git_revision"]} if manifest["git_revision"] else {}
    assert about == {"task": "Hopper-v4", "algorithm": "dppo", "samples": str(best), **revision}


def test_card_has_the_licence_of_the_package_and_noise_if_there_is_some(tmp_path):
    untrained = make_untrained("scalar", tmp_path)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    config = dataclasses.replace(untrained.config, noise=dg.NoiseConfig(reward=0.5, initial=0.01))
    made = arrays.arrays_of(untrained.networks, untrained.config, untrained.index)
    facts = bundle.facts_of(untrained.file, untrained.file, untrained.config, untrained.index)
    facts |= {"task": "Hopper-v4", "algorithm": "trpo", "best": False}
    plain, noisy = (
        bundle.model_card("npz", made, each, 0, facts) for each in (untrained.config, config)
    )
    assert f"| licence | {project['license']}, that of dgae_jax |" in plain
    assert "noise" not in plain
    assert "None" not in plain
    assert "| noise in training | reward 0.5, initial 0.01 |\n" in noisy


def test_facts_of_a_policy_file_come_from_its_sweep(tmp_path):
    config = resolve(small())
    (tmp_path / "policies").mkdir()
    file = tmp_path / "policies" / "hopper-ppo-0.msgpack"
    file.write_bytes(b"")
    names = ("checkpoint", "samples", "returns", "versions", "git_revision")
    unknown = dict(zip(names, (file.name, None, None, "", None), strict=True))
    assert bundle.facts_of(file, file, config, 0) == unknown
    row = {
        "policy": "policies/hopper-ppo-0.msgpack",
        "seed": 0,
        "steps": 999_424,
        "final": {"return_mean": 3298.14, "return_std": 8.25, "returns": [0.0] * 20},
        "git_revision": "abcdef1+",
        "versions": {"jax": "0.10.2", "warp": None},
    }
    rows = [row, {**row, "seed": 1, "steps": 1}, {**row, "policy": "policies/other.msgpack"}]
    (tmp_path / "results.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))
    returns = "3,298.1 ± 8.2 over 20 episodes"
    known = (file.name, 999_424, returns, "jax 0.10.2", "abcdef1+")
    assert tuple(bundle.facts_of(file, file, config, 0).values()) == known
    hostile = {**row, "steps": "many", "final": [1], "versions": 3, "git_revision": "| x |"}
    (tmp_path / "results.jsonl").write_text(json.dumps(hostile) + "\n")
    assert bundle.facts_of(file, file, config, 0) == unknown


@pytest.fixture
def export(monkeypatch, capsys):
    """`dgae export` in this process: exit code, stdout, stderr."""

    def export(*argv):
        monkeypatch.setattr(sys, "argv", ["dgae export", *map(str, argv)])
        try:
            code = command("export")()
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return export


def test_each_format_becomes_a_directory(trained, export, tmp_path):
    run_dir = shutil.copytree(trained, tmp_path / "run")
    code, out, err = export(run_dir, "--to", *FORMATS, "--index", 1)
    assert (code, err) == (0, "")
    assert [line.split(": ")[1] for line in out.splitlines()] == [
        "policy.npz, policy.py, README.md",
        "policy.onnx, README.md",
        "policy.npz, policy.py, agent.py, README.md",
    ]
    written = {path.name for path in (run_dir / "export").rglob("*") if path.is_file()}
    assert written == {"README.md", "agent.py", "policy.npz", "policy.onnx", "policy.py"}


def test_policy_file_is_exported_beside_itself_and_again(export, tmp_path):
    file = make_untrained("scalar", tmp_path).file
    for _ in range(2):
        assert export(file, "--to", "npz", "npz")[0] == 0
    names = sorted(path.name for path in (tmp_path / "scalar-export" / "npz").iterdir())
    assert names == ["README.md", "policy.npz", "policy.py"]
    assert export(file, "--to", "npz", "--checkpoint", "best")[0] == 2


def test_seeds_and_checkpoints_have_their_own_weights(trained, export, tmp_path):
    run_dir = shutil.copytree(trained, tmp_path / "run")

    def weights(*argv):
        assert export(run_dir, "--to", "npz", "--out", tmp_path / "a" / "b", *argv)[0] == 0
        with np.load(tmp_path / "a" / "b" / "npz" / "policy.npz") as arrays:
            return arrays["policy_weight_0"]

    first, second, default = (weights(*argv) for argv in (["--index", 0], ["--index", 1], []))
    assert_array_equal(first, default)
    assert not np.array_equal(first, second)
    last(run_dir).unlink()
    assert not np.array_equal(weights(), first)


def test_unwritable_output_is_refused_in_one_line(trained, export, tmp_path):
    (tmp_path / "out" / "npz" / "policy.npz").mkdir(parents=True)
    for out in (tmp_path / "out", "/dev/null/x", trained / "config.json"):
        code, _, err = export(trained, "--to", "npz", "--out", out)
        assert code == 2
        assert f"--out {out}: must be a directory that can be written" in " ".join(err.split())


def test_missing_onnx_is_named_and_other_formats_work(trained, export, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnx", None)
    code, _, err = export(trained, "--to", "npz", "onnx", "--out", tmp_path / "out")
    assert code == 2
    assert 'pip install "dgae_jax[export]"' in err
    assert not (tmp_path / "out").exists()
    assert export(trained, "--to", "npz", "gymnasium", "--out", tmp_path / "out")[0] == 0


def test_agent_needs_a_task_that_gymnasium_has(trained, export, tmp_path):
    run_dir = shutil.copytree(trained, tmp_path / "run")
    config = json.loads((run_dir / "config.json").read_text())
    config |= {"env": "brax:ant", "env_version": None, "physics": "mjx"}
    (run_dir / "config.json").write_text(json.dumps(config))
    code, _, err = export(run_dir, "--to", "gymnasium")
    assert code == 2
    assert "--to gymnasium: must be left out with brax:ant" in err
