"""Which OpenGL is taken."""

import os

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.export import gl


@pytest.fixture
def works(monkeypatch):
    """Names of the backends that draw; what was tried is noted."""
    monkeypatch.delenv(gl.VARIABLE, raising=False)
    names, tried = set(), []
    monkeypatch.setattr(gl, "draws", lambda backend: tried.append(backend) or backend in names)
    return names, tried


@pytest.mark.parametrize(("there", "taken", "looked_at"), [
    ({"egl", "osmesa"}, "egl", ["egl"]),
    ({"osmesa"}, "osmesa", ["egl", "osmesa"]),
])  # fmt: skip
def test_egl_is_taken_before_osmesa_and_said_to_mujoco(there, taken, looked_at, works):
    names, tried = works
    names |= there
    assert gl.choose() == taken == os.environ[gl.VARIABLE]
    assert tried == looked_at


def test_none_is_refused_with_what_to_install(works):
    with pytest.raises(
        ConfigError,
        match="neither egl nor osmesa draws a picture here; on Debian: apt install libegl1",
    ):
        gl.choose()
    assert gl.VARIABLE not in os.environ


def test_what_the_user_chose_is_taken_or_refused_and_never_replaced(works, monkeypatch):
    names, tried = works
    names |= {"egl", "glfw"}
    monkeypatch.setenv(gl.VARIABLE, "glfw")
    assert gl.choose() == "glfw"
    monkeypatch.setenv(gl.VARIABLE, "osmesa")
    with pytest.raises(
        ConfigError, match=r"^MUJOCO_GL=osmesa: must be egl, osmesa or another that draws"
    ):
        gl.choose()
    assert tried == ["glfw", "osmesa"]


def test_a_name_that_mujoco_does_not_know_draws_nothing():
    assert not gl.draws("abacus")
