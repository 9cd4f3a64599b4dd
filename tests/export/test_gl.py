"""Choice of the OpenGL backend."""

import os

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.export import gl


@pytest.fixture
def tried(monkeypatch):
    """Names of the backends that work, and a list of those tried."""
    monkeypatch.setenv(gl.VARIABLE, "")  # so that it is restored
    working, tried = set(), []
    monkeypatch.setattr(gl, "works", lambda name: tried.append(name) or name in working)
    return working, tried


@pytest.mark.parametrize(
    ("working", "chosen", "expected"),
    [({"egl", "osmesa"}, "egl", ["egl"]), ({"osmesa"}, "osmesa", ["egl", "osmesa"])],
)
def test_egl_is_preferred_to_osmesa(working, chosen, expected, tried):
    tried[0].update(working)
    assert gl.choose() == chosen == os.environ[gl.VARIABLE]
    assert tried[1] == expected


def test_no_backend_is_refused_with_what_to_install(tried):
    with pytest.raises(ConfigError, match="apt install libegl1"):
        gl.choose()
    assert not os.environ[gl.VARIABLE]


def test_the_users_backend_is_never_replaced(tried, monkeypatch):
    tried[0].update({"egl", "glfw"})
    monkeypatch.setenv(gl.VARIABLE, "glfw")
    assert gl.choose() == "glfw"
    monkeypatch.setenv(gl.VARIABLE, "osmesa")
    with pytest.raises(ConfigError, match=r"^MUJOCO_GL=osmesa: cannot draw"):
        gl.choose()
    assert tried[1] == ["glfw", "osmesa"]


def test_an_unknown_backend_does_not_work():
    assert not gl.works("abacus")
