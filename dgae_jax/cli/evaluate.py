"""Evaluate a trained run: python experiments/evaluate.py RUN_DIR --engine gymnasium --episodes 100"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dgae_jax import ConfigError
from dgae_jax.cli.arguments import fail, parse
from dgae_jax.run import directory, files
from dgae_jax.run.checkpoint import CheckpointError
from dgae_jax.run.evaluation import evaluate_run
from dgae_jax.run.loop import describe


@dataclass(frozen=True)
class Arguments:
    """What to evaluate, and how."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run [path]."""
    engine: Literal["gymnasium", "native", "jax"] = "gymnasium"
    """gymnasium (the task of the gymnasium package), native (ours in C MuJoCo) or jax (ours in JAX)."""
    checkpoint: Literal["newest", "best"] = "newest"
    """newest, or best: of the evaluations while it trained, whose episodes chose it; take another --seed to judge it."""
    episodes: int = 20
    """Episodes per trained run [episodes]."""
    seed: int = 0
    """Seed of the initial states [1]."""
    out: Path | None = None
    """File to write; by default evaluation-ENGINE.json in the run directory [path]."""


def main() -> int:
    """Evaluate one run directory; 0 done, 2 bad input, 130 stopped by SIGINT."""
    arguments = parse(Arguments, "Evaluate the deterministic policy of a trained run.")
    if arguments.episodes < 1:
        fail(f"--episodes {arguments.episodes}: must be a whole number of at least 1")
    if not 0 <= arguments.seed < 2**31:
        fail(f"--seed {arguments.seed}: must be a whole number from 0 to {2**31 - 1:,}")
    if arguments.out and not arguments.out.absolute().parent.is_dir():
        fail(f"--out {arguments.out}: must be a file in a directory that exists")
    if arguments.out and (arguments.out.is_symlink() or (arguments.out.exists() and not arguments.out.is_file())):
        fail(f"--out {arguments.out}: must be a file, not a directory, a link or a device")
    out = arguments.out or arguments.run_dir / f"evaluation-{arguments.engine}.json"
    if arguments.run_dir.is_dir() and not os.access(out.absolute().parent, os.W_OK):
        fail(f"--out {out}: must be a file that can be written")
    try:
        config = directory.read_config(arguments.run_dir)
        how = {"which": arguments.checkpoint, "engine": arguments.engine, "episodes": arguments.episodes, "seed": arguments.seed}
        result = evaluate_run(arguments.run_dir, config, **how)
        files.write_json(out, result)
    except (ConfigError, CheckpointError) as mistake:
        fail(str(mistake))
    except OSError as reason:
        fail(f"--out {out}: must be a file that can be written ({reason.strerror})")
    except KeyboardInterrupt:
        print("stopped by SIGINT, nothing written", file=sys.stderr)
        return 130
    print(f"{describe(result)}, {result['checkpoint']}; written to {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
