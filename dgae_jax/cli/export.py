"""Export a trained policy: `dgae export RUN_DIR --to npz onnx gymnasium`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dgae_jax.cli import parse
from dgae_jax.cli.evaluate import Choice
from dgae_jax.configs.config import invalid
from dgae_jax.envs.registry import spec_of
from dgae_jax.export import onnx_model
from dgae_jax.run import files, terminal


@dataclass(frozen=True, kw_only=True)
class Arguments(Choice):
    """Export a trained policy and its critic for programs without JAX.

    Examples:
      dgae export runs/walker --to npz
      dgae export runs/walker --to npz onnx gymnasium --checkpoint best
      dgae export policies/hopper-dppo-1.msgpack --to onnx --out hopper
    """

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or the file of a policy [path]."""
    to: tuple[Literal["npz", "onnx", "gymnasium"], ...]
    """One or more of npz (arrays and a program of NumPy alone), onnx (a model for ONNX Runtime and
    others) and gymnasium (an agent without JAX); each gets its own directory."""
    out: Path | None = None
    """Directory to write npz/, onnx/ and gymnasium/ in; by default export in the run directory, or
    beside the policy's file with its name in front [path]."""
    seed: tyro.conf.Suppress[int] = 0


@parse.command(Arguments)
def export(args: Arguments) -> None:
    """Export one policy."""
    if not args.to:
        raise invalid("to", "nothing", "one or more of npz, onnx, gymnasium")
    if "onnx" in args.to:
        onnx_model.check_installed()
    config = args.config(args.run_dir)
    if "gymnasium" in args.to and spec_of(config.env).eval_env() is None:
        raise invalid("to", "gymnasium", f"left out with {config.env}, which Gymnasium lacks")
    out = args.out or files.beside(args.run_dir, "export")
    parse.check_directory(out)
    from dgae_jax.export import bundle

    parse.use_one_device(config, args.cache_dir)
    formats = list(dict.fromkeys(args.to))
    with parse.writing(out, "directory"):
        written = bundle.export(args.run_dir, config, args.checkpoint, args.index, formats, out)
    for kind, names in written.items():
        terminal.say(f"written to {out / kind}: {', '.join(names)}")
