import dataclasses
import json

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.image import imread

import dgae_jax as dg
from dgae_jax.configs.build import make_task, make_trainer, seed_keys
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.serial import to_dict
from dgae_jax.run import checkpoint, curve, directory, files, metrics
from dgae_jax.run.checkpoint import CheckpointError
from dgae_jax.run.evaluation import EvaluationsFile, evaluate_state
from dgae_jax.run.options import RunOptions
from dgae_jax.run.record import Record
from tests.helpers import SMALL, signed


@pytest.fixture(scope="module")
def state():
    return make_trainer(make_task(SMALL), 1).init(SMALL, seed_keys(SMALL))


def saved(state, directory, steps, **keep):
    """A checkpoint of `state` after so many samples."""
    then = state._replace(iteration=jnp.full_like(state.iteration, steps // SMALL.samples_per_iteration))
    return checkpoint.save(directory, SMALL, checkpoint.arrays_of(then), steps, **keep)


def plain(state):
    return jax.device_get(state._replace(key=jax.random.key_data(state.key)))


def test_a_checkpoint_gives_the_state_back_bit_for_bit(state, tmp_path):
    loaded = checkpoint.load(saved(state, tmp_path, 0), SMALL)
    chex.assert_trees_all_equal(plain(loaded), plain(state))
    chex.assert_trees_all_equal_shapes_and_dtypes(loaded, state)


def test_the_newest_checkpoints_are_kept_and_the_best(state, tmp_path):
    directory = tmp_path / "checkpoints"
    directory.mkdir()
    for steps in (64, 128, 6400, 9600):
        saved(state, directory, steps, keep=2, best=64)
    assert [p.name for p in checkpoint.found(directory)] == [f"steps_{steps:012d}.msgpack" for steps in (64, 6400, 9600)]
    assert checkpoint.newest(tmp_path, SMALL)[1].name == "steps_000000009600.msgpack"
    assert checkpoint.at(tmp_path, 64, SMALL)[1].name == "steps_000000000064.msgpack"
    saved(state, directory, 12800, keep=2, best=9600)
    assert [p.name for p in checkpoint.found(directory)] == [f"steps_{steps:012d}.msgpack" for steps in (9600, 12800)]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda b: b[:100], "is damaged"),
        (lambda b: b"", "is damaged"),
        (lambda b: b"\x00" * 50, "is damaged"),
        (lambda b: b"\xa3abc", "is damaged"),
        (lambda b: b"\x93\x01\xa1a\x02", "is damaged"),
        (lambda b: b[:-9] + b"x" + b[-8:], "is damaged"),
        (lambda b: b.replace(b'"schema": 1', b'"schema": 2'), "has schema 2; this version reads schema 1"),
        (lambda b: signed(b.partition(b"\n")[2].replace(b"critic.", b"cretic.")), "is of another run, cretic.* is unknown here"),
        (lambda b: b.replace(b'"schema": 1', b'"schema": 1e999'), "is damaged"),
        (lambda b: b.replace(b'"schema": 1', b'"schema": true'), "is damaged"),
        (lambda b: signed(b"\x93\x01\xa1a\x02"), "is damaged"),
        (lambda b: signed(b"\x81\xa1a\xc1"), "is damaged"),
    ],
)
def test_a_damaged_checkpoint_is_refused_by_name(damage, reason, state, tmp_path):
    path = saved(state, tmp_path, 64)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(CheckpointError, match=f"{path.name}: {reason}"):
        checkpoint.load(path, SMALL)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"env_version": "v5"}, r"its env_version is v4, here v5"),  # arrays of the same shapes
        ({"env": "ant"}, r"its env is hopper, here ant"),
        ({"policy": dataclasses.replace(SMALL.policy, hidden=(9,))}, r"its policy\.hidden is \(8,\), here \(9,\)"),
    ],
)
def test_a_checkpoint_of_another_environment_or_network_is_refused_by_both_values(change, reason, state, tmp_path):
    path = saved(state, tmp_path, 64)
    with pytest.raises(CheckpointError, match=f"{path.name}: is of another run, {reason}"):
        checkpoint.load(path, dataclasses.replace(SMALL, **change))
    checkpoint.load(path, dataclasses.replace(SMALL, total_steps=9999, physics="jax"))


def test_arrays_of_other_shapes_are_refused_by_name_whatever_configuration_they_claim(state, tmp_path):
    arrays = checkpoint.arrays_of(state)
    name = next(name for name in arrays if name.startswith("policy.params"))
    path = checkpoint.save(tmp_path, SMALL, {**arrays, name: np.zeros((2, 2), np.float16)}, 0)
    with pytest.raises(CheckpointError, match=rf"is of another run, {name} is float16\(2, 2\), here float32\(1, "):
        checkpoint.load(path, SMALL)


def test_a_checkpoint_whose_configuration_has_other_names_is_of_another_version(state, tmp_path):
    path = saved(state, tmp_path, 0)
    path.write_bytes(signed(path.read_bytes().partition(b"\n")[2].replace(b"gamma", b"gemma")))
    with pytest.raises(CheckpointError, match=r"is of another version \(gamma: missing\)"):
        checkpoint.load(path, SMALL)


def test_a_checkpoint_saved_behind_damaged_ones_is_kept(state, tmp_path):
    for steps in (64, 128, 192, 256):
        saved(state, tmp_path, steps, keep=9)
    for damaged in (192, 256):
        (tmp_path / f"steps_{damaged:012d}.msgpack").write_bytes(b"")
    saved(state, tmp_path, 160, keep=1)
    assert [int(p.stem[6:]) for p in checkpoint.found(tmp_path)] == [160, 192, 256]


def test_a_renamed_checkpoint_is_refused(state, tmp_path):
    path = saved(state, tmp_path, 64).rename(tmp_path / "steps_000000000128.msgpack")
    with pytest.raises(CheckpointError, match="is renamed, it was saved after 1 iterations"):
        checkpoint.load(path, SMALL)


def test_a_directory_without_checkpoints_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="must hold a checkpoint"):
        checkpoint.newest(tmp_path, SMALL)


def test_a_damaged_checkpoint_gives_way_to_an_older_one_and_links_are_not_followed(state, tmp_path, capsys):
    directory = tmp_path / "checkpoints"
    directory.mkdir()
    whole, broken = (saved(state, directory, steps) for steps in (64, 128))
    broken.write_bytes(broken.read_bytes()[:-1])
    (directory / "steps_000000000192.msgpack").symlink_to(whole)
    _, path = checkpoint.newest(tmp_path, SMALL)
    assert path == whole
    warning = f"warning: {broken}: is damaged (its checksum differs); falling back to {whole.name}\n"
    assert capsys.readouterr().err == warning
    whole.unlink()
    with pytest.raises(CheckpointError, match="its checksum differs"):
        checkpoint.newest(tmp_path, SMALL)


def test_metrics_are_one_json_object_per_run_and_iteration(tmp_path):
    config = dg.Config(seed=7, num_seeds=2, num_envs=10, horizon=10)
    file = metrics.MetricsFile(tmp_path / "metrics.jsonl", config, 0)
    columns = {"episode_return": np.array([[1.5, np.nan], [2.0, 3.0], [0, 0]]), "episodes": np.array([[0, 1], [2, 3], [0, 0]])}
    file.append(columns, 2, 1.0)
    file.append(columns, 1, 2.0)
    rows = metrics.read(tmp_path / "metrics.jsonl")
    assert [(r["iteration"], r["steps"], r["seed"], r["episode_return"], r["episodes"]) for r in rows] == [
        (1, 100, 7, 1.5, 0), (1, 100, 8, None, 1), (2, 200, 7, 2, 2), (2, 200, 8, 3, 3), (3, 300, 7, 1.5, 0), (3, 300, 8, None, 1),
    ]  # fmt: skip
    assert "NaN" not in (tmp_path / "metrics.jsonl").read_text()


def test_metrics_continue_behind_the_checkpoint_whatever_followed_it(tmp_path):
    config, path = dg.Config(num_envs=10, horizon=10), tmp_path / "metrics.jsonl"
    columns = {"episode_return": np.arange(8.0)[:, None]}
    metrics.MetricsFile(path, config, 0).append(columns, 8, 1.5)
    path.write_text(path.read_text() + '{"iteration": 9, "st')  # torn
    file = metrics.MetricsFile(path, config, 5)
    assert (file.iteration, file.seconds) == (5, 1.5)
    file.append(columns, 2, 2.0)
    assert [row["iteration"] for row in metrics.read(path)] == [1, 2, 3, 4, 5, 6, 7]
    steps, returns = file.curve()
    np.testing.assert_array_equal(steps, 100 * np.arange(1, 8))
    np.testing.assert_array_equal(returns[:, 0], [0, 1, 2, 3, 4, 0, 1])
    with pytest.raises(ConfigError, match="must hold the 9 iterations"):
        metrics.MetricsFile(path, config, 9)
    for seconds in ("NaN", "Infinity", "-1", '"inf"', "null"):
        path.write_text(path.read_text().replace('"seconds": 2.0', f'"seconds": {seconds}'))
        before = path.read_bytes()
        with pytest.raises(ConfigError, match="must hold the 7 iterations"):
            metrics.MetricsFile(path, config, 7)
        assert path.read_bytes() == before
        path.write_text(path.read_text().replace(f'"seconds": {seconds}', '"seconds": 2.0'))


EVALUATIONS = [
    {"steps": steps, "seed": seed, "return_mean": mean, "return_std": 1.0}
    for steps, means in ((100, (1.0, 9.0)), (200, (6.0, 6.0)), (300, (2.0, 10.0)), (400, (5.0, 5.0)))
    for seed, mean in enumerate(means)
]


def test_the_best_evaluation_is_the_one_with_the_highest_mean_over_seeds_and_of_equals_the_later(tmp_path):
    path = tmp_path / "evaluations.jsonl"
    assert EvaluationsFile(path).best is None
    files.append_rows(path, EVALUATIONS)
    assert EvaluationsFile(path).best == 300
    assert not EvaluationsFile(path).has(500)
    cut = EvaluationsFile(path)
    cut.cut(250, 2)
    assert EvaluationsFile(path).best == 200
    np.testing.assert_array_equal(EvaluationsFile(path).points(), [[100, 1, 1], [100, 9, 1], [200, 6, 1], [200, 6, 1]])


def test_an_evaluation_that_lacks_a_seed_is_made_again(tmp_path):
    path = tmp_path / "evaluations.jsonl"
    files.append_rows(path, EVALUATIONS[:3])
    file = EvaluationsFile(path)
    assert file.has(200)
    file.cut(1000, 2)
    assert file.has(100)
    assert not file.has(200)


@pytest.mark.parametrize(
    "row", [{}, {"steps": -1}, {"steps": 2.5}, {"steps": True}, {"return_mean": "9"}, {"return_mean": 1e400}, {"return_std": -1}]
)
def test_an_evaluation_that_is_none_is_passed_over(row, tmp_path):
    path = tmp_path / "evaluations.jsonl"
    files.append_rows(path, [EVALUATIONS[0], {**EVALUATIONS[1], **row} if row else {}])
    assert len(EvaluationsFile(path).rows) == 1


@pytest.mark.parametrize("seeds", [1, 3])
def test_the_learning_curve_is_drawn_with_and_without_returns_and_evaluations(seeds, tmp_path):
    returns = np.log(np.arange(1.0, 20)[:, None] + np.arange(seeds))
    returns[:3] = np.nan
    dots = np.array([[100, 2.0, 0.5], [150, 3.0, 0.1]])
    images = []
    for name, figure in (
        ("none", curve.learning_curve(np.arange(1, 4), returns[:3], "title")),
        ("curve", curve.learning_curve(10 * np.arange(1, 20), returns, "title")),
        ("dots", curve.learning_curve(10 * np.arange(1, 20), returns, "title", dots)),
    ):
        curve.save(figure, tmp_path / f"{name}.png")
        images.append(imread(tmp_path / f"{name}.png")[..., :3])

    def share(image, red, green, blue):
        return np.mean(np.abs(image - np.array([red, green, blue]) / 255).max(-1) < 0.1)

    blue, orange = (31, 119, 180), (255, 127, 14)
    assert [share(image, *blue) > 0.001 for image in images[1:]] == [True, True]
    assert [share(image, *orange) > 0.0001 for image in images] == [False, False, True]
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["curve.png", "dots.png", "none.png"]


def test_a_long_run_is_drawn_from_its_first_to_its_last_iteration_in_a_thousand_points():
    steps = np.arange(1, 30_001)
    line = curve.learning_curve(steps, np.sqrt(steps)[:, None], "title").axes[0].lines[0]
    x, y = (np.asarray(each) for each in line.get_data())
    assert (len(x), x[0], x[-1]) == (1000, 1, 30_000)
    np.testing.assert_array_equal(y, np.sqrt(x))


def test_an_incident_can_be_replayed_from_its_file(state, tmp_path):
    qpos, *rest = state.episodes.incident[0]
    broken = state._replace(
        episodes=state.episodes._replace(
            incident=(type(state.episodes.incident[0])(qpos.at[0, 2].set(9), *rest), state.episodes.incident[1] + 0.5)
        )
    )
    record = Record(tmp_path, SMALL, RunOptions(debug_nonfinite=True), 0)
    row = {"episode_return": np.zeros((2, 1)), "nonfinite": np.array([[0.0], [2.0]])}
    record.append(broken, row, 1)
    assert not (tmp_path / "nonfinite").exists()
    record.append(broken, jax.tree.map(lambda x: x[1:], row), 1)
    incident = np.load(tmp_path / "nonfinite" / "steps_000000000128_seed_0.npz")
    assert set(incident) == {"qpos", "qvel", "qacc_warmstart", "xpos", "cfrc_ext", "action"}
    env = make_task(SMALL)
    replayed = env.set_state(env.reset(jax.random.key(0)), incident["qpos"], incident["qvel"])
    assert float(replayed.pipeline_state.qpos[2]) == 9
    np.testing.assert_array_equal(incident["action"], 0.5)


def test_a_run_directory_says_what_the_run_is(tmp_path):
    directory.create(tmp_path / "a" / "b", SMALL, RunOptions())
    assert directory.read_config(tmp_path / "a" / "b") == SMALL
    manifest = json.loads((tmp_path / "a" / "b" / "manifest.json").read_text())
    assert manifest["versions"]["jax"] == jax.__version__
    assert {"command", "git_revision", "device", "python", "started"} <= set(manifest)


def test_a_used_or_unwritable_run_directory_is_refused_and_left_alone(tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(ConfigError, match=r"--run-dir .*: must be a new or empty directory"):
        directory.create(tmp_path, SMALL, RunOptions())
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]
    with pytest.raises(ConfigError, match=r"--run-dir .*: must be a directory that can be written"):
        directory.create(tmp_path / "note.txt" / "below", SMALL, RunOptions())
    with pytest.raises(ConfigError, match=r"--run-dir .*: must be a new or empty directory"):
        directory.create(tmp_path / "note.txt", SMALL, RunOptions())


def test_an_empty_run_directory_is_welcome(tmp_path):
    directory.create(tmp_path, SMALL, RunOptions())
    assert (tmp_path / "checkpoints").is_dir()


@pytest.mark.parametrize("text", ["", "[]", "{", '{"env": "hopper"}'])
def test_a_config_file_that_is_none_is_refused(text, tmp_path):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ConfigError, match=r"config\.json"):
        directory.read_config(tmp_path)


def test_a_config_file_with_an_impossible_value_is_refused(tmp_path):
    files.write_json(tmp_path / "config.json", to_dict(dataclasses.replace(SMALL, env="hoper")))
    with pytest.raises(ConfigError, match=r"config\.json: --env hoper: must be one of"):
        directory.read_config(tmp_path)


def test_an_environment_of_braxs_own_is_evaluated_in_mjx_only(state):
    with pytest.raises(ConfigError, match=r"--engine gymnasium: must be jax"):
        evaluate_state(state, dataclasses.replace(SMALL, env="brax:ant"), engine="gymnasium", episodes=1)


@pytest.mark.parametrize("engine", ["gymnasium", "native"])
def test_an_untrained_policy_falls_at_once_in_every_engine_and_each_seed_is_reported(engine):
    config = dataclasses.replace(SMALL, num_seeds=2, seed=3)
    state = make_trainer(dg.make_env("hopper", physics="native"), 1).init(config, seed_keys(config))
    result = evaluate_state(state, config, engine=engine, episodes=5)
    assert result["episodes"] == len(result["returns"]) == 10
    assert [s["seed"] for s in result["seeds"]] == [3, 4]
    assert result["returns"] == result["seeds"][0]["returns"] + result["seeds"][1]["returns"]
    assert result["return_mean"] == pytest.approx(np.mean(result["returns"]), rel=1e-4)
    assert result["return_std"] == pytest.approx(np.std(result["returns"]), rel=1e-3)
    assert 0 < result["return_mean"] < 300


def test_native_and_gymnasium_give_the_same_policy_the_same_return():
    config = dataclasses.replace(SMALL, seed=1)
    state = make_trainer(dg.make_env("hopper", physics="native"), 1).init(config, seed_keys(config))
    ours, theirs = (evaluate_state(state, config, engine=engine, episodes=40) for engine in ("native", "gymnasium"))
    error = (ours["return_std"] ** 2 + theirs["return_std"] ** 2) ** 0.5 / 40**0.5
    assert abs(ours["return_mean"] - theirs["return_mean"]) < 4 * error
