"""Choice of the OpenGL backend."""

import os

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.export import gl


@pytest.mark.parametrize(
    ("asked", "working", "chosen"),
    [
        ("", ["egl", "osmesa"], "egl"),
        ("", ["osmesa"], "osmesa"),
        ("glfw", ["egl", "glfw"], "glfw"),
        ("", [], "cannot draw with egl or osmesa; apt install libegl1"),
        ("osmesa", ["egl"], "cannot draw with osmesa; unset it"),  # it is never replaced
    ],
)
def test_first_backend_that_works_is_chosen(asked, working, chosen, monkeypatch):
    monkeypatch.setenv(gl.VARIABLE, asked)
    monkeypatch.setattr(gl, "works", working.__contains__)
    if chosen in working:
        assert gl.choose() == chosen == os.environ[gl.VARIABLE]
        return
    with pytest.raises(ConfigError, match=chosen):
        gl.choose()
    assert os.environ[gl.VARIABLE] == asked
