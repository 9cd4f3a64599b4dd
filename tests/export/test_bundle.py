"""Exported policies do outside what they do here, and `dgae export` writes them."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
import tomllib
from functools import partial

import numpy as np
import onnxruntime
import pytest
from numpy.testing import assert_allclose

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.export import bundle
from dgae_jax.export.templates.policy import Policy
from dgae_jax.run import checkpoint
from dgae_jax.run.directory import read_config
from dgae_jax.run.evaluation import evaluate_policies
from tests.export.conftest import make_untrained
from tests.helpers import ROOT
from tests.runs import last

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
    policy = dg.load_policy(untrained.file, seed=untrained.index)
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


def test_onnx_runtime_computes_the_policy_for_any_batch(exported):
    _, obs, directory = exported
    file = str(directory / "onnx" / "policy.onnx")
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    run = partial(session.run, ["action", "quantiles"])
    assert_same(*run({"obs": obs}), exported)
    assert [x.shape[0] for x in run({"obs": obs[:1]})] == [1, 1]


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
        bundle.arrays_of(found._replace(policy=renamed), config, 0)


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


def test_card_shows_the_facts_of_the_run(trained, cards):
    manifest = json.loads((trained / "manifest.json").read_text())
    rows = [json.loads(line) for line in (trained / "evaluations.jsonl").read_text().splitlines()]
    text = (cards / "npz" / "README.md").read_text()
    best = int(re.search(r"\| checkpoint \| steps_0*(\d+).msgpack \|\n", text)[1])
    (mean,) = (row["return_mean"] for row in rows if (row["steps"], row["seed"]) == (best, 1))
    for fact in (
        "| task | Hopper-v4, episodes of at most 20 steps, observations [11], actions [3] |\n",
        "| algorithm | dppo |\n",
        "| trained on | hopper-v4, engine native, seed 1 |\n",
        f"| samples | {best} |\n",
        f"{mean:,.1f} ± 0.0 over 1 episode, mean ± standard deviation, episodes which chose this",
        "| critic | quantile [8], of the discounted return (γ = 0.99) of rewards divided",
        f"jax {manifest['versions']['jax']}",
    ):
        assert fact in text


def test_facts_of_a_policy_file_come_from_its_sweep(tmp_path):
    (tmp_path / "policies").mkdir()
    made = make_untrained("scalar", tmp_path / "policies")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

    def card(config=made.config):
        values = bundle.arrays_of(made.networks, config, 0)
        facts = bundle.facts_of(made.file, made.file, config, 0) | {"best": False}
        return bundle.model_card("npz", values, config, 0, facts)

    assert f"| licence | {project['license']}, that of dgae_jax |" in card()
    assert not re.search("noise|None|samples", card())
    noise = dg.NoiseConfig(reward=0.5, initial=0.01)
    noisy = card(dataclasses.replace(made.config, noise=noise))
    assert "| noise in training | reward 0.5, initial 0.01 |\n" in noisy
    row = {
        "policy": "policies/scalar.msgpack",
        "seed": made.config.seed,
        "steps": 999_424,
        "final": {"return_mean": 3298.14, "return_std": 8.25, "returns": [0.0] * 20},
        "git_revision": "abcdef1+",
        "versions": {"jax": "0.10.2", "warp": None},
    }
    rows = [row, {**row, "seed": 9, "steps": 1}, {**row, "policy": "policies/other.msgpack"}]
    (tmp_path / "results.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))
    for fact in ("999,424", "3,298.1 ± 8.2 over 20 episodes", "jax 0.10.2 |", "abcdef1+ |"):
        assert fact in card()


def test_each_format_becomes_a_directory(dgae, monkeypatch, tmp_path):
    file = make_untrained("scalar", tmp_path).file
    for _ in range(2):  # files are replaced
        code, out, err = dgae("export", file, "--to", *FORMATS, "--index", 1)
        assert (code, err) == (0, "")
    assert [line.split(": ")[1] for line in out.splitlines()] == [
        "policy.npz, policy.py, README.md",
        "policy.onnx, README.md",
        "policy.npz, policy.py, agent.py, README.md",
    ]
    monkeypatch.setitem(sys.modules, "onnx", None)
    code, _, err = dgae("export", file, "--to", "npz", "onnx", "--out", tmp_path / "out")
    assert (code, 'pip install "dgae_jax[export]"' in err) == (2, True)
    assert not (tmp_path / "out").exists()


def test_seeds_and_checkpoints_have_their_own_weights(trained, tmp_path):
    run_dir, config = shutil.copytree(trained, tmp_path / "run"), read_config(trained)

    def weights(index):
        bundle.export(run_dir, config, "latest", index, ["npz"], tmp_path)
        return Policy(tmp_path / "npz" / "policy.npz").arrays["policy_weight_0"].sum()

    first, second = weights(0), weights(1)
    last(run_dir).unlink()
    assert len({first, second, weights(0)}) == 3
