"""From episodes to frames, and from frames to files."""

import io

import numpy as np
import pytest
from PIL import Image

from dgae_jax.export import film, video
from dgae_jax.export.film import arranged, shown, side_by_side
from tests.helpers import film_of


def frames(count, size=(48, 64)):
    """Noise, which no encoder can make small."""
    random = np.random.default_rng(0)
    return [random.integers(0, 255, (*size, 3), np.uint8) for _ in range(count)]


def test_a_frame_shows_the_last_state_that_has_begun_and_the_last_frame_the_last():
    assert shown(10, dt=0.1, fps=5) == [0, 2, 4, 6, 9]
    assert shown(4, dt=0.05, fps=40) == [0, 0, 1, 1, 2, 2, 3, 3]
    assert shown(1000, dt=0.008, fps=25)[-2:] == [990, 999]
    assert shown(1, dt=0.008, fps=25) == shown(1, dt=0.05, fps=20) == [0]


def test_a_robot_that_fell_stands_still_beside_one_that_walks_on_and_all_at_the_end():
    short, long = frames(2), frames(4)
    rows = list(side_by_side([iter(short), iter(long)], hold=2))
    lefts, rights = [row[:, :64] for row in rows], [row[:, 64:] for row in rows]
    np.testing.assert_array_equal(lefts, [short[0], *[short[1]] * 5])
    np.testing.assert_array_equal(rights, [*long, long[3], long[3]])


@pytest.mark.parametrize("fps", [10, 25])
def test_an_mp4_has_the_frames_and_the_speed_that_were_given(fps, tmp_path):
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, :32] = (0, 114, 178)
    pictures = [np.roll(picture, 4 * i, axis=1) for i in range(9)]
    assert video.write(iter(pictures), tmp_path / "a.b", ("mp4",), fps) == [tmp_path / "a.b.mp4"]
    film, speed = film_of(tmp_path / "a.b.mp4")
    assert (film.shape, speed) == ((9, 48, 64, 3), fps)
    assert np.abs(film.astype(int) - pictures).mean() < 8
    assert [p.name for p in tmp_path.iterdir()] == ["a.b.mp4"]


def test_a_gif_has_half_of_the_frames_and_runs_as_fast_for_ever(tmp_path):
    video.write(frames(9), tmp_path / "film", ("gif",), 25)
    with Image.open(tmp_path / "film.gif") as gif:
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"], gif.size) == (
            5,
            80,
            0,
            (64, 48),
        )


@pytest.mark.parametrize(("fps", "frames_per_second"), [(10, 10), (18, 9), (30, 10), (100, 12.5)])
def test_a_gif_never_has_more_frames_per_second_than_it_may(fps, frames_per_second, tmp_path):
    video.write(frames(16), tmp_path / "film", ("gif",), fps)
    with Image.open(tmp_path / "film.gif") as gif:
        assert gif.info["duration"] == pytest.approx(
            1000 / frames_per_second, abs=5
        )  # it counts in hundredths of a second


def test_both_files_come_from_one_pass_over_the_frames(tmp_path):
    names = [
        path.name
        for path in video.write(iter(frames(4)), tmp_path / "film", video.FORMATS["both"], 25)
    ]
    assert names == ["film.mp4", "film.gif"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.gif", "film.mp4"]


def test_a_gif_that_is_too_large_is_made_again_until_it_fits():
    images = [Image.fromarray(frame) for frame in frames(8)]
    best, smaller = video.gif(images, 12.5), video.gif(images, 12.5, most=8_000)
    assert len(smaller) <= 8_000 < len(best)
    with Image.open(io.BytesIO(smaller)) as gif:
        assert gif.size[0] < 64
        assert gif.info["duration"] * gif.n_frames == pytest.approx(640, rel=0.3)


def test_a_film_without_frames_and_a_directory_that_is_not_there_are_errors(tmp_path):
    with pytest.raises(ValueError, match="at least one frame"):
        video.write([], tmp_path / "film", ("mp4",), 25)
    with pytest.raises(OSError, match="No such file"):
        video.write(frames(2), tmp_path / "nowhere" / "film", ("gif",), 25)


def test_half_a_second_at_least_is_left_to_see_how_an_episode_ended():
    assert film.HOLD >= 0.5


def test_up_to_three_robots_stand_in_a_row_and_more_in_a_square_with_white_for_those_that_are_missing():
    one, two, three, four, five = (np.full((2, 2, 3), level, np.uint8) for level in (1, 2, 3, 4, 5))
    assert arranged([one, two, three])[0, :, 0].tolist() == [1, 1, 2, 2, 3, 3]
    assert arranged([one, two, three, four])[::2, ::2, 0].tolist() == [[1, 2], [3, 4]]
    assert arranged([one, two, three, four, five])[::2, ::2, 0].tolist() == [[1, 2, 3], [4, 5, 255]]
