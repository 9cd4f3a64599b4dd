"""`dgae render` and `dgae figures` as a user meets them."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image, ImageSequence

from dgae_jax.export import gl, strip
from dgae_jax.run import checkpoint
from dgae_jax.run.directory import read_config
from dgae_jax.run.training import train_command
from tests.helpers import ROOT, command, film_of
from tests.runs import QUIET, last, small

WIDTH, HEIGHT, FPS = 200, 120, 25
SMALL = ["--width", str(WIDTH), "--height", str(HEIGHT), "--cache-dir", QUIET.cache_dir]


@pytest.fixture(scope="module")
def opengl():
    if not any(gl.draws(backend) for backend in gl.CANDIDATES):
        pytest.skip(f"neither {' nor '.join(gl.CANDIDATES)} draws a picture here")


def made(tmp_path_factory, algo):
    run_dir = tmp_path_factory.mktemp("runs") / algo
    train_command(small(algo), dataclasses.replace(QUIET, run_dir=run_dir))
    return run_dir


@pytest.fixture(scope="module")
def distributional(tmp_path_factory):
    return made(tmp_path_factory, "dppo")


@pytest.fixture(scope="module")
def scalar(tmp_path_factory):
    return made(tmp_path_factory, "ppo")


@pytest.fixture
def run(monkeypatch, capsys):
    """A command in this process, which draws nothing."""

    def run(name, *argv):
        monkeypatch.setattr(sys, "argv", [name, *map(str, argv)])
        try:
            code = command(name)()
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return run


def dgae(*argv):
    """A command in a process of its own, which has OpenGL; what it printed."""
    script, *rest = map(str, argv)
    done = subprocess.run(
        [sys.executable, f"experiments/{script}.py", *rest],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def length(path):
    """Of a GIF, whose frames that stand still may be one [ms]."""
    with Image.open(path) as gif:
        return sum(frame.info["duration"] for frame in ImageSequence.Iterator(gif))


def test_a_film_of_a_run_is_an_mp4_and_a_gif_in_which_the_robot_moves_over_its_strip(
    distributional, tmp_path, opengl
):
    out = dgae(
        "render",
        distributional,
        "--seconds",
        0.4,
        "--episodes",
        2,
        "--out",
        tmp_path / "film",
        *SMALL,
    )
    assert re.search(
        rf"^written to {tmp_path / 'film'}\.mp4 \(.* MB\)\nwritten to {tmp_path / 'film'}\.gif \(.* MB\)\n$",
        out,
        re.MULTILINE,
    )
    film, fps = film_of(tmp_path / "film.mp4")
    assert fps == FPS
    states = (
        20  # the small run's episodes are cut there: 0.16 s, 4 frames, and 15 at the end of each
    )
    assert film.shape == (2 * (int(states * 0.008 * FPS) + 15), HEIGHT + strip.HEIGHT, WIDTH, 3)
    robot, below = film[:, :HEIGHT].astype(int), film[:, HEIGHT:].astype(int)
    assert np.abs(robot[3] - robot[0]).max() > 60
    assert np.abs(below[3] - below[0]).max() > 60
    assert np.abs(robot[10] - robot[9]).mean() < 2
    assert length(tmp_path / "film.gif") == 19 * 80


def test_runs_side_by_side_and_a_scalar_critic(distributional, scalar, tmp_path, opengl):
    dgae(
        "render",
        distributional,
        "--compare",
        scalar,
        "--out",
        tmp_path / "film.mp4",
        "--format",
        "mp4",
        *SMALL,
    )
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    film, _ = film_of(tmp_path / "film.mp4")
    assert film.shape[1:] == (HEIGHT + strip.HEIGHT, 2 * WIDTH, 3)
    left, right = film[0, HEIGHT:, :WIDTH].astype(int), film[0, HEIGHT:, WIDTH:].astype(int)
    sky = np.array([0x56, 0xB4, 0xE9])
    paler = 0.6 * sky + 0.4 * 255
    blue = [(np.abs(part[45:95] - paler).max(-1) < 40).sum() for part in (left, right)]
    assert blue[0] > 100
    assert blue[1] == 0


def test_learning_is_shown_checkpoint_after_checkpoint(distributional, tmp_path, opengl):
    dgae(
        "render", distributional, "--during", "--format", "gif", "--out", tmp_path / "film", *SMALL
    )
    kept = len(list((distributional / "checkpoints").iterdir()))
    assert kept == 2
    assert length(tmp_path / "film.gif") == 19 * 80


def test_the_file_of_a_policy_is_filmed_beside_it_and_has_nothing_to_show_from_its_training(
    distributional, tmp_path, opengl, run
):
    config, file = read_config(distributional), tmp_path / "policy.msgpack"
    found = checkpoint.load_networks(distributional, config, "latest")
    checkpoint.save_networks(file, config, found, checkpoint.reward_std(found.path, config))
    dgae("render", file, "--format", "gif", *SMALL)
    assert length(tmp_path / "policy-film.gif") > 0
    assert run("render", file, "--during")[::2] == (
        2,
        f"error: --during: must be left out with {file}, a single policy\n",
    )


def test_every_checkpoint_is_found_and_a_damaged_one_left_out(distributional, tmp_path, capsys):
    config = read_config(distributional)
    names = [f"steps_{steps:012d}.msgpack" for steps in (256, 512)]
    assert [found.path.name for found in checkpoint.load_all_networks(distributional, config)] == [
        "steps_000000000256.msgpack",
        "steps_000000000512.msgpack",
    ]
    shutil.copytree(distributional, tmp_path / "run")
    latest = last(tmp_path / "run")
    latest.write_bytes(latest.read_bytes()[:-100])
    assert [
        found.path.name for found in checkpoint.load_all_networks(tmp_path / "run", config)
    ] == names[:1]
    assert re.fullmatch(r"warning: .*000512\.msgpack.*; left out\n", capsys.readouterr().err)


def test_the_scale_of_rewards_is_that_of_the_training_state(distributional):
    config = read_config(distributional)
    state, path = checkpoint.latest_train_state(distributional, config)
    std = checkpoint.reward_std(path, config)
    np.testing.assert_array_equal(std, state.reward_scale.returns.std)
    assert std.shape == (1,)
    assert std[0] != 1
    unscaled = dataclasses.replace(config, normalize_rewards=False)
    np.testing.assert_array_equal(checkpoint.reward_std(path, unscaled), [1])


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["nowhere"], r"nowhere: must be a run directory; there is nothing of that name"),
        ([".", "--episodes", "0"], r"--episodes 0: must be a whole number from 1 to 1,000"),
        ([".", "--width", "481"], r"--width 481: must be an even number from 160 to 1,920"),
        ([".", "--seconds", "0"], r"--seconds 0\.0: must be a number above 0, up to 600"),
        ([".", "--seconds", "nan"], r"--seconds nan: must be a number above 0, up to 600"),
        ([".", "--format", "avi"], r"--format avi: must be one of"),
        ([".", "--during", "--compare", "a"], r"--compare a: must be left out with --during"),
        (
            [".", "--during", "--checkpoint", "best"],
            r"--checkpoint best: must be left out with --during",
        ),
        (
            [".", "--checkpoint", "last"],
            r"--checkpoint last: must be one of (best|latest), (best|latest)",
        ),
    ],
)
def test_render_refuses_bad_input_in_one_line(argv, message, run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("render", *argv)
    assert (code, out) == (2, "")
    assert re.fullmatch(rf"error: .*{message}.*\n", err)


def test_render_refuses_a_run_that_gymnasium_cannot_play_a_seed_that_is_not_there_and_a_file_that_cannot_be(
    distributional, run, tmp_path, monkeypatch
):
    monkeypatch.setattr(gl, "choose", lambda: pytest.fail("it was not refused"))
    shutil.copytree(distributional, tmp_path / "run")
    assert run("render", tmp_path / "run", "--index", 1)[::2] == (
        2, f"error: --index 1: must be a whole number from 0 to 0, the index of a seed in {tmp_path / 'run'}\n",
    )  # fmt: skip
    assert re.fullmatch(
        r"error: --out .*: must be a file in a directory .*\n",
        run("render", tmp_path / "run", "--out", "/nowhere/x")[2],
    )
    (tmp_path / "film.gif").mkdir()
    code, _, err = run(
        "render", tmp_path / "run", "--out", tmp_path / "film.gif", "--format", "gif"
    )
    assert (code, err) == (
        2,
        f"error: --out {tmp_path / 'film.gif'}: must be a file, not a directory, a link or a device\n",
    )
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    config |= {"env": "brax:ant", "env_version": None, "physics": "mjx"}
    (tmp_path / "run" / "config.json").write_text(json.dumps(config))
    code, _, err = run("render", tmp_path / "run")
    assert code == 2
    assert re.fullmatch(
        r"error: \S+: must be a run of ant, hopper, swimmer, walker2d, which can be filmed; it is one of brax:ant\n",
        err,
    )


@pytest.mark.parametrize("module", ["mediapy", "imageio_ffmpeg"])
def test_a_missing_encoder_is_named_with_how_to_install_it(module, run, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    code, out, err = run("render", ".")
    assert (code, out) == (2, "")
    assert re.fullmatch(
        rf'error: {module.replace("_", "-")} is not installed.*: pip install "dgae_jax\[video\]".*\n',
        err,
    )
    assert "config.json" in run("render", ".", "--format", "gif")[2]


@pytest.mark.parametrize("name", ["render", "figures"])
def test_without_opengl_a_command_ends_in_one_line(
    name, distributional, run, monkeypatch, tmp_path
):
    monkeypatch.delenv(gl.VARIABLE, raising=False)
    monkeypatch.setattr(gl, "draws", lambda _: False)
    monkeypatch.chdir(tmp_path)
    code, out, err = run(name, *([distributional] if name == "render" else []))
    assert (code, out) == (2, "")
    assert re.fullmatch(r"error: MUJOCO_GL: neither egl nor osmesa draws .*\n", err)
    assert list(tmp_path.iterdir()) == []


def test_the_transport_of_mass_is_drawn_without_opengl_with_the_same_bytes_each_time(
    run, monkeypatch, tmp_path
):
    monkeypatch.setattr(gl, "draws", lambda _: False)
    for name in ("first", "second"):
        code, out, err = run("figures", "--only", "transport", "--out", tmp_path / name)
        assert (code, err) == (0, "")
        assert out.count("written to") == 2
    for file in ("transport.png", "transport.svg"):
        first, second = ((tmp_path / name / file).read_bytes() for name in ("first", "second"))
        assert first == second
    assert (tmp_path / "first" / "transport.svg").read_text().count("<svg") == 1


def test_a_directory_that_cannot_be_made_is_refused_in_one_line(run, tmp_path):
    (tmp_path / "file").write_text("")
    code, _, err = run("figures", "--only", "transport", "--out", tmp_path / "file")
    assert code == 2
    assert re.fullmatch(
        r"error: --out .*file: must be a directory that can be written \(File exists\)\n", err
    )


def test_the_four_robots_are_four_different_pictures_on_light_ground(tmp_path, opengl):
    dgae("figures", "--only", "robots", "--out", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["robots.png"]
    with Image.open(tmp_path / "robots.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    quarters = np.array_split(pixels[:, : pixels.shape[1] // 4 * 4], 4, axis=1)
    for quarter in quarters:
        brown = (np.abs(quarter - (204, 153, 102)).max(-1) < 60).mean()
        assert 0.005 < brown < 0.5
        assert quarter.mean() > 150
    assert all(np.abs(a - b).mean() > 3 for a, b in pairwise(quarters))
