"""Shapes and dtypes in annotations are checked while tests run; compiled programs are kept between runs."""

import os
import signal
import tempfile

import jaxtyping

jaxtyping.install_import_hook(
    [f"dgae_jax.{room}" for room in ("maths", "physics", "envs", "learn")], "beartype.beartype"
)

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update(
    "jax_compilation_cache_dir", os.path.join(tempfile.gettempdir(), "dgae_jax_tests")
)  # noqa: PTH118


OPTIMIZATIONS = "JAX_DISABLE_MOST_OPTIMIZATIONS"


def pytest_configure(config):
    """The small programs of the default suite cost more to compile than to run; the slow tests train, and compile as users do."""
    if config.option.markexpr == "not slow" and OPTIMIZATIONS not in os.environ:
        os.environ[OPTIMIZATIONS] = "1"  # also in the processes that tests start
        jax.config.update(OPTIMIZATIONS.lower(), True)


@pytest.fixture(scope="session", autouse=True)
def _hang_ups_are_heard():
    """Also where the tests run under `nohup`, which processes inherit."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture
def key():
    return jax.random.key(0)


@pytest.fixture
def elsewhere(monkeypatch):
    """What a test traces is the program for a device that is not a CPU, though a CPU runs it."""
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, default, **_: default(*args))
