"""The machine a run is on."""

import jax
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import runtime
from dgae_jax.run.options import RunOptions
from tests.runs import SMALL


@pytest.mark.parametrize(
    ("wanted", "reason", "said"),
    [
        (
            "cuda",
            AssertionError(),
            r'an NVIDIA GPU needs pip install "dgae_jax\[cuda13\]"; JAX says: AssertionError$',
        ),
        ("abacus", RuntimeError("Unknown backend"), r"cuda13.*; JAX says: Unknown backend$"),
        ("cpu", ImportError("no jaxlib"), r"cpu for one; JAX says: no jaxlib$"),
    ],
)
def test_whatever_jax_says_about_a_device_is_one_line_that_says_how_to_install_for_a_gpu(
    wanted, reason, said, monkeypatch
):
    def devices():
        raise reason

    monkeypatch.setattr(jax, "devices", devices)
    monkeypatch.setenv("JAX_PLATFORMS", wanted)
    with pytest.raises(
        ConfigError,
        match=rf"^JAX_PLATFORMS={wanted}: must name a device that JAX finds here, .*{said}",
    ):
        runtime.use_devices(SMALL, RunOptions())
