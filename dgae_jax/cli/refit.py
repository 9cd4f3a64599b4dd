"""TrainableState a value distribution to a policy that is held fixed: dgae refit RUN_DIR

Flags are checked before the rest is imported: JAX, MuJoCo and Brax take seconds to load.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dgae_jax.cli.arguments import fail, parse, stopped
from dgae_jax.cli.source import check_file, check_index, check_seed
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import directory, files, terminal
from dgae_jax.run.options import RunOptions

PURPOSE = "TrainableState a value distribution to the returns of a policy held fixed."

EXAMPLES = (
    "dgae refit runs/first",
    "dgae refit runs/first --checkpoint best --worlds 512 --out first.msgpack",
    "dgae refit results/tuned/policies/hopper-ppo-0.msgpack --out hopper.msgpack",
)

MOST_WORLDS = 10_000


@dataclass(frozen=True)
class Arguments:
    """Whose returns, and how many of them."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or the file of a policy [path]."""
    checkpoint: Literal["latest", "best"] = "latest"
    """latest, or best: of the evaluations while it trained."""
    index: int = 0
    """Which of the seeds that were trained side by side, from 0."""
    worlds: int = 128
    """Worlds that are played, each for as many steps as an episode may have, 1 to 10,000; more fit the tails better [worlds]."""
    seed: int = 0
    """Seed of the episodes and of the fit [1]."""
    out: Path | None = None
    """File to write, of the policy as it is with the new critic; by default refit.msgpack in the run directory, or beside the policy's
    file, with its name in front [path]."""
    cache_dir: str = RunOptions.cache_dir
    """Where compiled programs are kept between runs; none disables [path]."""


def main() -> int:
    """TrainableState one critic; 0 done, 2 bad input, 130 stopped by SIGINT."""
    terminal.prepare()
    try:
        arguments = parse(Arguments, PURPOSE, examples=EXAMPLES)
        return _refit(arguments, *_checked(arguments))
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT, nothing written")


def _checked(arguments: Arguments) -> tuple[ResolvedConfig, Path]:
    """The run's configuration and the file to write; raises ConfigError for the first argument that is invalid."""
    if not 1 <= arguments.worlds <= MOST_WORLDS:
        raise invalid("worlds", arguments.worlds, f"a whole number from 1 to {MOST_WORLDS:,}")
    check_seed(arguments.seed)
    config = directory.config_of(arguments.run_dir)
    check_index(arguments.index, config, arguments.run_dir)
    out = arguments.out or files.beside(arguments.run_dir, "refit.msgpack")
    check_file(out)
    own = out.exists() and out.samefile(arguments.run_dir)
    if out.suffix != ".msgpack" or own or out.absolute().parent.name == "checkpoints":
        raise invalid(
            "out",
            out,
            "a file whose name ends in .msgpack, not the policy's own and not among the checkpoints of a run",
        )
    return config, out


def _refit(arguments: Arguments, config: ResolvedConfig, out: Path) -> int:
    from dgae_jax.run import calibration, checkpoint, runtime
    from dgae_jax.run.terminal import Reporter

    runtime.use_devices(config, RunOptions(devices=1, num_processes=1))
    runtime.use_cache(arguments.cache_dir)
    how = {
        "which": arguments.checkpoint,
        "index": arguments.index,
        "seed": arguments.seed,
        "num_envs": arguments.worlds,
    }
    with Reporter() as reporter:
        found = calibration.refit(arguments.run_dir, config, **how, watch=reporter.watch)
    try:
        checkpoint.save_networks(out, found.config, found.networks, found.std)
    except OSError as reason:
        raise invalid("out", out, f"a file that can be written ({reason.strerror})") from reason
    terminal.say(
        f"fitted to {found.returns:,} returns with a standard deviation of {found.std[0]:,.1f}; written to {out}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
