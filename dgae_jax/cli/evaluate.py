"""Evaluate a trained run: python experiments/evaluate.py RUN_DIR --engine gymnasium --episodes 100"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dgae_jax import ConfigError
from dgae_jax.cli.arguments import fail, parse
from dgae_jax.run import directory, files, machine, terminal
from dgae_jax.run.checkpoint import CheckpointError
from dgae_jax.run.evaluation import default_path, engines_of, evaluate_run
from dgae_jax.run.options import WHOLE, RunOptions
from dgae_jax.run.progress import Reporter
from dgae_jax.run.summary import describe


@dataclass(frozen=True)
class Arguments:
    """What to evaluate, and how."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run [path]."""
    engine: Literal["gymnasium", "native", "jax"] | None = None
    """gymnasium (the task of the gymnasium package), native (ours in C MuJoCo) or jax (ours in JAX); by default the first
    that the run can have."""
    checkpoint: Literal["newest", "best"] = "newest"
    """newest, or best: of the evaluations while it trained, whose episodes chose it; take another --seed to judge it."""
    episodes: int = 20
    """Episodes per trained run [episodes]."""
    seed: int = 0
    """Seed of the initial states [1]."""
    out: Path | None = None
    """File to write; by default evaluation-ENGINE.json or evaluation-ENGINE-best.json in the run directory [path]."""
    cache_dir: str = RunOptions.cache_dir
    """Where compiled programs are kept between runs; none disables [path]."""


def main() -> int:
    """Evaluate one run directory; 0 done, 2 bad input, 130 stopped by SIGINT."""
    arguments = parse(Arguments, "Evaluate the deterministic policy of a trained run.")
    low, high, reason = WHOLE["episodes"]
    if not low <= arguments.episodes <= high:
        fail(f"--episodes {arguments.episodes}: must be a whole number from {low:,} to {high:,} ({reason})")
    if not 0 <= arguments.seed < 2**31:
        fail(f"--seed {arguments.seed}: must be a whole number from 0 to {2**31 - 1:,}")
    if arguments.out and not arguments.out.absolute().parent.is_dir():
        fail(f"--out {arguments.out}: must be a file in a directory that exists")
    if arguments.out and (arguments.out.is_symlink() or (arguments.out.exists() and not arguments.out.is_file())):
        fail(f"--out {arguments.out}: must be a file, not a directory, a link or a device")
    terminal.prepare()
    out = arguments.out
    try:
        config = directory.read_config(arguments.run_dir)
        engine = arguments.engine or engines_of(config)[0]
        out = out or default_path(arguments.run_dir, engine, arguments.checkpoint)
        if not os.access(out.absolute().parent, os.W_OK):
            fail(f"--out {out}: must be a file that can be written")
        machine.use_device(config)
        machine.use_cache(arguments.cache_dir)
        how = {"which": arguments.checkpoint, "engine": engine, "episodes": arguments.episodes, "seed": arguments.seed}
        with Reporter() as reporter:
            result = evaluate_run(arguments.run_dir, config, **how, watch=reporter.watch)
        files.write_json(out, result)
    except (ConfigError, CheckpointError) as mistake:
        fail(str(mistake))
    except OSError as reason:
        fail(f"--out {out}: must be a file that can be written ({reason.strerror})")
    except KeyboardInterrupt:
        terminal.warn("stopped by SIGINT, nothing written")
        return 130
    terminal.say(f"{describe(result)}, {result['checkpoint']}; written to {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
