"""The policy in other people's programs does what it does here."""

import dataclasses
import json
import re
import subprocess
import sys
import tomllib
from functools import partial

import gymnasium
import jax
import numpy as np
import onnx
import onnxruntime
import pytest

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.export import arrays, bundle, card
from dgae_jax.export.facts import facts_of
from dgae_jax.export.outside.policy import Policy
from dgae_jax.run import checkpoint
from dgae_jax.run.evaluation import evaluate_policies
from dgae_jax.run.training import train_command
from tests.helpers import ROOT
from tests.runs import QUIET, last, small

LOUD = {"quantile": 100, "scalar": 30, "ordered": 100, "sorted": 100}
"""The last layer of a small run's policy is small; so many times larger its actions reach the actuators' range."""


def shaped(config, hidden):
    policy, critic = (
        dataclasses.replace(part, hidden=hidden) for part in (config.policy, config.critic)
    )
    return dataclasses.replace(config, policy=policy, critic=critic)


def state_covariance(config):
    policy = dataclasses.replace(config.policy, covariance="state")
    return dataclasses.replace(
        config, policy=policy, normalize_observations=False, normalize_rewards=False
    )


def of_kind(config, kind):
    return resolve(
        dataclasses.replace(
            config, critic=dataclasses.replace(config.critic, kind=kind, kappa=None)
        )
    )


CONFIGS = {
    "quantile": shaped(small("dppo"), (8, 6)),
    "ordered": of_kind(shaped(small("dppo"), (8, 6)), "ordered"),
    "sorted": of_kind(shaped(small("dppo"), (8, 6)), "sorted"),
    "scalar": state_covariance(small("trpo", seeds=2)),
}
"""Between them all critics, both covariances, one and two hidden layers, with and without normaliser, one seed and two."""

KINDS = {"quantile": 8, "scalar": 1, "ordered": 8, "sorted": 8}
INDEX = {"quantile": 0, "scalar": 1, "ordered": 0, "sorted": 0}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    made = {name: tmp_path_factory.mktemp("runs") / name for name in CONFIGS}
    for name, run_dir in made.items():
        train_command(CONFIGS[name], dataclasses.replace(QUIET, run_dir=run_dir))
    return made


@pytest.fixture(scope="module", params=CONFIGS)
def exported(request, runs, tmp_path_factory):
    """A policy's file with loud actions, exported in every format: name, policy, observations, directory."""
    name, directory = request.param, tmp_path_factory.mktemp("exported")
    config, index = CONFIGS[name], INDEX[request.param]
    found = checkpoint.load_networks(runs[name], config, "latest")
    head = found.policy.params["params"]["Dense_0"]
    params = {
        "params": {
            **found.policy.params["params"],
            "Dense_0": {**head, "kernel": LOUD[name] * head["kernel"]},
        }
    }
    file = directory / "loud.msgpack"
    loud = found._replace(policy=found.policy._replace(params=params))
    checkpoint.save_networks(file, config, loud, checkpoint.reward_std(found.path, config))
    bundle.export(file, config, "latest", index, tuple(bundle.FILES), directory)
    statistics = found.policy.observations
    mean, std = (
        (0, 1)
        if statistics is None
        else (np.asarray(statistics.mean[index]), np.asarray(statistics.std[index]))
    )
    obs = (mean + 5 * std * np.random.default_rng(1).normal(size=(1000, 11))).astype(np.float32)
    assert statistics is None or (np.abs((obs - mean) / std) > 10).mean() > 0.01
    return name, dg.load_policy(file, seed=index), obs, directory


def is_the_same(actions, quantiles, exported):
    name, policy, obs, _ = exported
    assert quantiles.shape == (1000, KINDS[name])
    assert (actions.dtype, quantiles.dtype) == (np.float32, np.float32)
    at_the_range = (np.abs(policy(obs)) == 1).mean()
    assert 0.05 < at_the_range < 0.95
    np.testing.assert_allclose(actions, policy(obs), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(quantiles, policy.quantiles(obs), rtol=1e-5, atol=1e-5)
    assert np.ptp(quantiles) > 0.1


def outside(directory, *argv):
    """A program in the exported directory, in a Python that has neither JAX nor this package."""
    words = ", ".join(repr(word) for word in argv)
    program = (
        "import sys, runpy; sys.path.insert(0, ''); sys.modules.update(jax=None, jaxlib=None, flax=None, dgae_jax=None);"
        f"sys.argv = [{words}]; runpy.run_path({argv[0]!r}, run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=directory, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_numpy_alone_acts_and_predicts_as_the_policy(exported, tmp_path):
    _, _, obs, directory = exported
    np.save(tmp_path / "obs.npy", obs)
    (tmp_path / "use.py").write_text(
        "import sys, numpy as np\nfrom policy import Policy\npolicy, obs = Policy('policy.npz'), np.load(sys.argv[1])\n"
        "np.savez(sys.argv[2], actions=policy(obs), quantiles=policy.quantiles(obs), one=policy(obs[0]))\n"
    )
    outside(
        directory / "npz",
        str(tmp_path / "use.py"),
        str(tmp_path / "obs.npy"),
        str(tmp_path / "out.npz"),
    )
    with np.load(tmp_path / "out.npz") as out:
        is_the_same(out["actions"], out["quantiles"], exported)
        np.testing.assert_allclose(out["one"], out["actions"][0], atol=1e-6)
    assert {path.name for path in (directory / "npz").iterdir()} == {
        "policy.npz",
        "policy.py",
        "README.md",
    }


def test_onnx_runtime_acts_and_predicts_as_the_policy_for_any_batch(exported):
    _, _, obs, directory = exported
    session = onnxruntime.InferenceSession(
        str(directory / "onnx" / "policy.onnx"), providers=["CPUExecutionProvider"]
    )
    run = partial(session.run, ["action", "quantiles"])
    is_the_same(*run({"obs": obs}), exported)
    one = run({"obs": obs[:1]})
    assert [x.shape[0] for x in one] == [1, 1]
    (taken,) = session.get_inputs()
    assert (taken.name, taken.type, taken.shape) == ("obs", "tensor(float)", ["batch", 11])


def test_a_model_is_valid_and_its_metadata_say_what_it_is(runs, tmp_path):
    bundle.export(runs["quantile"], CONFIGS["quantile"], "latest", 0, ["onnx"], tmp_path)
    model = onnx.load(tmp_path / "onnx" / "policy.onnx")
    onnx.checker.check_model(model, full_check=True)
    about = {each.key: each.value for each in model.metadata_props}
    revision = json.loads((runs["quantile"] / "manifest.json").read_text())["git_revision"]
    assert about == {"task": "Hopper-v4", "algorithm": "dppo", "samples": "512"} | (
        {"git_revision": revision} if revision else {}
    )


@pytest.mark.parametrize("name", CONFIGS)
def test_the_agent_plays_the_episodes_of_an_evaluation_without_jax(name, runs, tmp_path):
    config, index = CONFIGS[name], INDEX[name]
    bundle.export(runs[name], config, "latest", index, ["gymnasium"], tmp_path)
    out = outside(tmp_path / "gymnasium", "agent.py", "--episodes", "4", "--seed", "3").splitlines()
    policies = checkpoint.load_networks(runs[name], config, "latest").policy
    want = evaluate_policies(policies, config, engine="gymnasium", episodes=4, seed=3)["seeds"][
        index
    ]
    played = [
        float(line.removeprefix(f"episode {i + 1}: return ")) for i, line in enumerate(out[:-1])
    ]
    assert len(set(played)) == 4
    np.testing.assert_allclose(played, want["returns"], rtol=1e-3)
    printed = re.fullmatch(r"mean (-?\d+\.\d{4}), standard deviation (\d+\.\d{4})", out[-1])
    assert printed  # of returns that were not rounded to four places, as those printed are: half a digit here and half there
    np.testing.assert_allclose(
        [float(x) for x in printed.groups()],
        [np.mean(played), np.std(played)],
        rtol=0,
        atol=1.01e-4,
    )


@pytest.mark.parametrize("argv", [["--episodes", "0"], ["--seed", "-1"]])
def test_the_agent_refuses_what_cannot_be_played(argv, runs, tmp_path):
    bundle.export(runs["quantile"], CONFIGS["quantile"], "latest", 0, ["gymnasium"], tmp_path)
    done = subprocess.run(
        [sys.executable, tmp_path / "gymnasium" / "agent.py", *argv], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "--episodes must be at least 1 and --seed at least 0" in done.stderr


def test_the_arrays_are_those_of_the_checkpoint_and_the_task(runs):
    config = CONFIGS["quantile"]
    found = checkpoint.load_networks(runs["quantile"], config, "latest")
    made = arrays.arrays_of(found, config, 0)
    world = gymnasium.make("Hopper-v5").action_space
    np.testing.assert_array_equal(
        [made["action_low"], made["action_high"]], [world.low, world.high]
    )
    np.testing.assert_array_equal(made["observation_std"], found.policy.observations.std[0])
    torso = found.critic.params["params"]["Torso_0"]
    np.testing.assert_array_equal(made["critic_weight_1"], torso["Dense_1"]["kernel"][0])
    shapes = {name: x.shape for name, x in made.items() if "weight" in name}
    assert shapes == {
        "policy_weight_0": (11, 8), "policy_weight_1": (8, 6), "policy_weight_2": (6, 3),
        "critic_weight_0": (11, 8), "critic_weight_1": (8, 6), "critic_weight_2": (6, 8),
    }  # fmt: skip
    assert (str(made["env"]), int(made["episode_length"]), float(made["observation_limit"])) == (
        "Hopper-v4",
        20,
        10,
    )


def test_a_policy_by_hand():
    # normalised (2, -10) by mean 1, std 2 and the limit 10; one tanh layer that keeps its input; 3 * tanh(2) + 1 is cut to 2
    made = {
        "observation_mean": np.float32([1, 0]), "observation_std": np.float32([2, 1]), "observation_limit": np.float32(10),
        "policy_weight_0": np.eye(2, dtype=np.float32), "policy_bias_0": np.zeros(2, np.float32),
        "policy_weight_1": np.float32([[3], [0]]), "policy_bias_1": np.float32([1]),
        "critic_weight_0": np.float32([[1, 0], [0, 0.1]]), "critic_bias_0": np.zeros(2, np.float32),
        "critic_weight_1": np.float32([[1, 0], [0, 2]]), "critic_bias_1": np.float32([0, 5]),
        "action_low": np.float32([-2]), "action_high": np.float32([2]),
    }  # fmt: skip
    policy = Policy.__new__(Policy)
    policy.arrays = made
    np.testing.assert_allclose(policy([5, -99]), [2])
    np.testing.assert_allclose(
        policy.quantiles([5, -99]), [np.tanh(2), 5 + 2 * np.tanh(-1)], rtol=1e-6
    )


def test_networks_of_another_make_are_refused(runs):
    config = CONFIGS["quantile"]
    found = checkpoint.load_networks(runs["quantile"], config, "latest")
    strange = found._replace(
        policy=found.policy._replace(params={"params": {"Body": found.policy.params["params"]}})
    )
    with pytest.raises(ConfigError, match=r"to be exported; 'kernel' is missing"):
        arrays.arrays_of(strange, config, 0)
    swapped = found._replace(
        critic=found.critic._replace(
            observations=jax.tree.map(lambda x: x + 1, found.critic.observations)
        )
    )
    with pytest.raises(
        ConfigError, match=r"to be exported; as plain layers their quantiles differ"
    ):
        arrays.arrays_of(swapped, config, 0)


def test_the_card_says_what_the_runs_files_say(runs, tmp_path):
    run_dir, config = runs["quantile"], CONFIGS["quantile"]
    bundle.export(run_dir, config, "latest", 0, ["npz", "onnx", "gymnasium"], tmp_path)
    cards = {kind: (tmp_path / kind / "README.md").read_text() for kind in bundle.FILES}
    evaluation, manifest = (
        json.loads((run_dir / name).read_text()) for name in ("evaluation.json", "manifest.json")
    )
    worth = f"{evaluation['return_mean']:,.1f} ± {evaluation['return_std']:,.1f} over 1 episode"
    for kind, text in cards.items():
        assert text.startswith("# DPPO on Hopper-v4\n")
        for row in (
            "| task | Hopper-v4, episodes of at most 20 steps, observations [11], actions [3] |",
            "| algorithm | dppo |",
            "| trained on | hopper-v4, engine native, seed 0 |",
            "| samples | 512 |",
            f"| return in Hopper-v4 (gymnasium) | {worth}, mean ± standard deviation |",
            "| critic | quantile [8], of the discounted return (γ = 0.99) of rewards divided by a standard deviation of returns |",
            f"| checkpoint | {last(run_dir).name} |",
            "| licence | Apache-2.0, that of dgae_jax |",
        ):
            assert row in text
        assert f"jax {manifest['versions']['jax']}" in text
        assert ("git revision" in text) == bool(manifest["git_revision"])
        assert (manifest["git_revision"] or "") in text
        assert {"npz": "policy.py", "onnx": "onnxruntime", "gymnasium": "python agent.py"}[
            kind
        ] in text


def test_a_card_has_the_licence_of_the_package_and_the_noise_of_the_training(runs):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["license"] == card.LICENCE
    config, made = (
        CONFIGS["scalar"],
        facts_of(runs["scalar"], last(runs["scalar"]), CONFIGS["scalar"], 1),
    )
    plain = arrays.arrays_of(checkpoint.load_networks(runs["scalar"], config, "latest"), config, 1)
    quiet, noisy = (
        card.card("npz", plain, dataclasses.replace(config, noise=noise), 1, made, "latest")
        for noise in (dg.NoiseConfig(), dg.NoiseConfig(reward=0.5, initial=0.01))
    )
    assert "noise" not in quiet
    assert "| noise in training | reward 0.5, initial 0.01 |\n" in noisy
    assert "| critic | scalar [1], of the discounted return (γ = 0.99) |\n" in quiet
    assert "| trained on | hopper-v4, engine native, seed 1 |\n" in quiet


def test_the_programs_on_the_cards_run_as_they_are_printed(exported):
    *_, directory = exported
    for kind in ("npz", "onnx"):
        _, block, _ = (
            (directory / kind / "README.md").read_text().replace("```python\n", "```").split("```")
        )
        (directory / kind / "use.py").write_text(block + "print(actions.shape, quantiles.shape)")
        assert outside(directory / kind, "use.py") == f"(5, 3) (5, {KINDS[exported[0]]})\n"
        (directory / kind / "use.py").unlink()


def test_of_the_best_checkpoint_the_card_says_that_its_episodes_chose_it(runs, tmp_path):
    run_dir, config = runs["scalar"], CONFIGS["scalar"]
    bundle.export(run_dir, config, "best", 1, ["npz"], tmp_path)
    text = (tmp_path / "npz" / "README.md").read_text()
    rows = [json.loads(line) for line in (run_dir / "evaluations.jsonl").read_text().splitlines()]
    means = {
        steps: np.mean([row["return_mean"] for row in rows if row["steps"] == steps])
        for steps in (256, 512)
    }
    best = max(means, key=lambda steps: (means[steps], steps))
    (mean,) = (row["return_mean"] for row in rows if (row["steps"], row["seed"]) == (best, 1))
    assert f"| samples | {best} |" in text
    assert (
        f"{mean:,.1f} ± 0.0 over 1 episode, mean ± standard deviation, episodes which chose this checkpoint |"
        in text
    )


def test_facts_of_a_policys_file_come_from_the_row_of_its_study(tmp_path):
    config = resolve(small())
    (tmp_path / "policies").mkdir()
    file = tmp_path / "policies" / "hopper-ppo-0.msgpack"
    file.write_bytes(b"")
    assert facts_of(file, file, config, 0) == (file.name, None, None, {}, None)
    final = {"return_mean": 3298.14, "return_std": 8.25, "returns": [0.0] * 20}
    row = {
        "policy": "policies/hopper-ppo-0.msgpack",
        "seed": 0,
        "steps": 999_424,
        "final": final,
        "git_revision": "abcdef1+",
    }
    others = [
        {**row, "seed": 1, "steps": 1},
        {**row, "policy": "policies/other.msgpack", "steps": 2},
    ]
    rows = [others[0], {**row, "versions": {"jax": "0.10.2", "warp": None}}, others[1]]
    (tmp_path / "results.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))
    worth = "3,298.1 ± 8.2 over 20 episodes"
    assert facts_of(file, file, config, 0) == (
        file.name,
        999_424,
        worth,
        {"jax": "0.10.2"},
        "abcdef1+",
    )
    hostile = {**row, "steps": "many", "final": [1], "versions": 3, "git_revision": "| x |"}
    (tmp_path / "results.jsonl").write_text(json.dumps(hostile) + "\n")
    assert facts_of(file, file, config, 0) == (file.name, None, None, {}, None)
