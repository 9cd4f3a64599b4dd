"""Check shapes and dtypes in annotations while tests run; keep compiled programs between runs."""

import os
import signal
import tempfile

import jaxtyping

jaxtyping.install_import_hook(
    [f"dgae_jax.{room}" for room in ("maths", "physics", "envs", "learn")], "beartype.beartype"
)

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_compilation_cache_dir", f"{tempfile.gettempdir()}/dgae_jax_tests")

OPTIMIZATIONS = "JAX_DISABLE_MOST_OPTIMIZATIONS"


def pytest_configure(config):
    """Compile small programs quickly; slow tests train, and compile as users do."""
    if config.option.markexpr == "not slow" and OPTIMIZATIONS not in os.environ:
        os.environ[OPTIMIZATIONS] = "1"  # also in the processes that tests start
        jax.config.update(OPTIMIZATIONS.lower(), True)


@pytest.fixture(scope="session", autouse=True)
def _default_sighup():
    """Restore the default of SIGHUP, which `nohup` would ignore."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture
def key():
    return jax.random.key(0)


@pytest.fixture
def elsewhere(monkeypatch):
    """Trace the form of a program for devices other than CPUs."""
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, default, **_: default(*args))
