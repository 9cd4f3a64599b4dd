"""Evaluate a trained run: dgae evaluate RUN_DIR --episodes 100

Flags are checked before the rest is imported: JAX, MuJoCo and Brax take seconds to load.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dgae_jax.cli.arguments import fail, parse, stopped
from dgae_jax.cli.source import check_file, check_seed
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.run import directory, files, terminal
from dgae_jax.run.options import INTEGER_RANGES, RunOptions, engine_of

PURPOSE = "Evaluate the deterministic policy of a trained run."

EXAMPLES = (
    "dgae evaluate runs/walker --episodes 100",
    "dgae evaluate runs/walker --checkpoint best --seed 7",
    "dgae evaluate policies/hopper-dppo-1.msgpack --engine native --out hopper.json",
)


@dataclass(frozen=True)
class Arguments:
    """What to evaluate, and how."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or the file of a policy [path]."""
    engine: Literal["gymnasium", "native", "jax", "mjx", "mjx-warp"] | None = None
    """gymnasium (the task of the gymnasium package), or an engine as in --physics of the training; by default the first that the
    run can have."""
    checkpoint: Literal["latest", "best"] = "latest"
    """latest, or best: of the evaluations while it trained, whose episodes chose it; take another --seed to judge it."""
    episodes: int = 20
    """Episodes per trained run [episodes]."""
    seed: int = 0
    """Seed of the initial states; no two seeds share any [1]."""
    out: Path | None = None
    """File to write; by default evaluation-ENGINE.json or evaluation-ENGINE-best.json in the run directory, or beside the policy's
    file, with its name in front [path]."""
    cache_dir: str = RunOptions.cache_dir
    """Where compiled programs are kept between runs; none disables [path]."""


def main() -> int:
    """Evaluate one run directory; 0 done, 2 bad input, 130 stopped by SIGINT."""
    terminal.prepare()
    try:
        arguments = parse(Arguments, PURPOSE, examples=EXAMPLES)
        _check(arguments)
        return _evaluate(arguments)
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT, nothing written")


def _check(arguments: Arguments) -> None:
    """Raise ConfigError for the first argument that is invalid."""
    low, high, reason = INTEGER_RANGES["episodes"]
    if not low <= arguments.episodes <= high:
        raise invalid(
            "episodes", arguments.episodes, f"a whole number from {low:,} to {high:,} ({reason})"
        )
    check_seed(arguments.seed)


def _evaluate(arguments: Arguments) -> int:
    config = directory.config_of(arguments.run_dir)
    from dgae_jax.run import evaluation, runtime
    from dgae_jax.run.evaluation import describe
    from dgae_jax.run.terminal import Reporter

    engine = engine_of(config, arguments.engine)
    out = arguments.out or evaluation.default_path(arguments.run_dir, engine, arguments.checkpoint)
    check_file(out)
    runtime.use_devices(config, RunOptions(devices=1, num_processes=1))
    runtime.use_cache(arguments.cache_dir)
    how = {
        "which": arguments.checkpoint,
        "engine": engine,
        "episodes": arguments.episodes,
        "seed": arguments.seed,
    }
    with Reporter() as reporter:
        result = evaluation.evaluate_run(arguments.run_dir, config, **how, watch=reporter.watch)
    try:
        files.write_json(out, result)
    except OSError as reason:
        raise invalid("out", out, f"a file that can be written ({reason.strerror})") from reason
    terminal.say(f"{describe(result)}, {result['checkpoint']}; written to {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
