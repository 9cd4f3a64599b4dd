"""Take a trained policy out of a run: dgae export RUN_DIR --to npz onnx gymnasium

Flags are checked before the rest is imported: JAX, MuJoCo and Brax take seconds to load.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dgae_jax.cli.arguments import fail, parse, stopped
from dgae_jax.cli.source import check_directory, check_index
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import spec_of
from dgae_jax.export import onnx_model
from dgae_jax.run import directory, files, terminal
from dgae_jax.run.options import RunOptions

PURPOSE = "Take a trained policy and its critic out of a run, for programs without JAX."

EXAMPLES = (
    "dgae export runs/walker --to npz",
    "dgae export runs/walker --to npz onnx gymnasium --checkpoint best",
    "dgae export policies/hopper-dppo-1.msgpack --to onnx --out hopper",
)


@dataclass(frozen=True)
class Arguments:
    """Which policy, and how it is to be used."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or the file of a policy [path]."""
    to: tuple[Literal["npz", "onnx", "gymnasium"], ...]
    """One or more of npz (arrays and a program of NumPy alone), onnx (a model for ONNX Runtime and others) and gymnasium (a program
    that plays the task without JAX); each becomes a directory of its own."""
    checkpoint: Literal["latest", "best"] = "latest"
    """latest, or best: of the evaluations while it trained."""
    index: int = 0
    """Which of the seeds that were trained side by side, from 0."""
    out: Path | None = None
    """Directory to write npz/, onnx/ and gymnasium/ in; by default export in the run directory, or beside the policy's file, with its
    name in front [path]."""


def main() -> int:
    """Export one policy; 0 done, 2 bad input, 130 stopped by SIGINT."""
    terminal.prepare()
    try:
        arguments = parse(Arguments, PURPOSE, examples=EXAMPLES)
        config, out = _checked(arguments)
        return _export(arguments, config, out)
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT")


def _checked(arguments: Arguments) -> tuple[ResolvedConfig, Path]:
    """The run's configuration and the directory to write in; raises ConfigError for the first argument that is invalid."""
    if not arguments.to:
        raise invalid("to", "nothing", "one or more of npz, onnx, gymnasium")
    if "onnx" in arguments.to:
        onnx_model.check_installed()
    config = directory.config_of(arguments.run_dir)
    check_index(arguments.index, config, arguments.run_dir)
    if "gymnasium" in arguments.to and spec_of(config.env).eval_env() is None:
        raise invalid(
            "to", "gymnasium", f"left out with {config.env}, which Gymnasium does not play"
        )
    out = arguments.out or files.beside(arguments.run_dir, "export")
    check_directory(out)
    return config, out


def _export(arguments: Arguments, config: ResolvedConfig, out: Path) -> int:
    from dgae_jax.export import bundle
    from dgae_jax.run import runtime

    runtime.use_devices(config, RunOptions(devices=1, num_processes=1))
    formats = list(dict.fromkeys(arguments.to))
    try:
        written = bundle.export(
            arguments.run_dir, config, arguments.checkpoint, arguments.index, formats, out
        )
    except OSError as reason:
        raise invalid(
            "out", out, f"a directory that can be written ({reason.strerror})"
        ) from reason
    for kind, names in written.items():
        terminal.say(f"written to {out / kind}: {', '.join(names)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
