"""What a run leaves beside its checkpoints."""

import time

import jax
import numpy as np

from dgae_jax.learn.build import make_task
from dgae_jax.run import checkpoint, logger
from dgae_jax.run.logger import RunLogger
from dgae_jax.run.options import RunOptions
from tests.runs import SMALL


def test_an_incident_can_be_replayed_from_its_file(state, tmp_path):
    qpos, *rest = state.episodes.incident[0]
    incident = (
        type(state.episodes.incident[0])(qpos.at[0, 1, 2].set(9), *rest),
        state.episodes.incident[1] + 0.5,
    )
    broken = state._replace(
        episodes=state.episodes._replace(
            incident=incident, nonfinite=state.episodes.nonfinite.at[0, 1].set(2)
        )
    )
    record = RunLogger(tmp_path, SMALL, RunOptions(debug_nonfinite=True), 0)
    row = {"episode_return": np.zeros((2, 1)), "nonfinite": np.array([[0.0], [2.0]])}
    record.append(broken, row, 1)
    assert not (tmp_path / "nonfinite").exists()
    record.append(broken, jax.tree.map(lambda x: x[1:], row), 1)
    incident = np.load(tmp_path / "nonfinite" / "steps_000000000128_seed_0.npz")
    assert set(incident) == {
        "world",
        "qpos",
        "qvel",
        "qacc_warmstart",
        "xpos",
        "cfrc_ext",
        "action",
    }
    np.testing.assert_array_equal(incident["world"], [1])
    env = make_task(SMALL)
    replayed = env.set_state(env.reset(jax.random.key(0)), incident["qpos"][0], incident["qvel"][0])
    assert float(replayed.pipeline_state.qpos[2]) == 9
    np.testing.assert_array_equal(incident["action"], 0.5)


def test_an_evaluation_is_noted_when_its_checkpoint_is_on_the_disk(state, tmp_path, monkeypatch):
    seen, save = [], checkpoint.save

    def slow(*args):
        time.sleep(0.5)
        seen.append((tmp_path / "evaluations.jsonl").read_bytes())
        save(*args)

    evaluation = {"seeds": [{"seed": 0, "return_mean": 1.0, "return_std": 0.0, "returns": [1.0]}]}
    monkeypatch.setattr(checkpoint, "save", slow)
    monkeypatch.setattr(logger, "evaluate_policies", lambda *_, **__: evaluation)
    with RunLogger(tmp_path, SMALL, RunOptions(), 0) as kept:
        kept.save(state)
        kept.evaluate(None, print)
    assert seen == [b""]
    assert [row["return_mean"] for row in kept.evaluations.rows] == [1.0]
