"""Compare critics with the returns that came: dgae calibrate RUN_DIR …

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
from dgae_jax.configs.parts import is_distribution
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import directory, files, terminal
from dgae_jax.run.options import RunOptions

PURPOSE = "Compare the value distributions of critics with the returns that came."

EXAMPLES = (
    "dgae calibrate runs/first",
    "dgae calibrate runs/first --checkpoint best --seed 1",
    "dgae calibrate runs/first runs/first/refit.msgpack --out calibration.png",
)


@dataclass(frozen=True)
class Arguments:
    """Whose critics, and where the picture goes."""

    run_dirs: tyro.conf.Positional[tuple[Path, ...]]
    """Directories of runs, or files of dgae refit and of policies [paths]."""
    checkpoint: Literal["latest", "best"] = "latest"
    """latest, or best: of the evaluations while it trained."""
    index: int = 0
    """Which of the seeds that were trained side by side, from 0."""
    seed: int = 0
    """Seed of the episodes [1]."""
    out: Path | None = None
    """PNG with a histogram per run, and their statistics in a JSON file of the same name; by default calibration.png in the directory
    of the first, or beside its file, with its name in front [path]."""
    cache_dir: str = RunOptions.cache_dir
    """Where compiled programs are kept between runs; none disables [path]."""


def main() -> int:
    """Write one picture and the statistics of all runs; 0 done, 2 bad input, 130 stopped by SIGINT."""
    terminal.prepare()
    try:
        arguments = parse(Arguments, PURPOSE, examples=EXAMPLES)
        return _calibrate(arguments, *_checked(arguments))
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT")


def _checked(arguments: Arguments) -> tuple[dict[Path, ResolvedConfig], Path]:
    """The runs, and the picture to write; raises ConfigError for the first thing that is invalid."""
    if not arguments.run_dirs:
        raise ConfigError("RUN_DIRS: must be one run directory or more (--help lists every flag)")
    names = [path.resolve().name for path in arguments.run_dirs]
    if len(set(names)) < len(names):
        raise ConfigError(
            f"RUN_DIRS {' '.join(names)}: must be of different names, by which their statistics are known"
        )
    runs = {path: (directory.config_of(path)) for path in arguments.run_dirs}
    for path, config in runs.items():
        if not is_distribution(str(config.critic.kind)):
            raise ConfigError(f"{path}: must be a run with a value distribution, not {config.algo}")
        check_index(arguments.index, config, path)
    check_seed(arguments.seed)
    out = arguments.out or files.beside(arguments.run_dirs[0], "calibration.png")
    if out.suffix != ".png":
        raise invalid("out", out, "a file whose name ends in .png")
    for file in (out, out.with_suffix(".json")):
        check_file(file)
    return runs, out


def _calibrate(arguments: Arguments, runs: dict[Path, ResolvedConfig], out: Path) -> int:
    from dgae_jax.report import figures
    from dgae_jax.run import calibration, metrics, runtime
    from dgae_jax.run.terminal import Reporter

    runtime.use_devices(next(iter(runs.values())), RunOptions(devices=1, num_processes=1))
    runtime.use_cache(arguments.cache_dir)
    for config in runs.values():
        calibration.check_returns(config)
    found, how = (
        {},
        {"which": arguments.checkpoint, "index": arguments.index, "seed": arguments.seed},
    )
    for path, config in runs.items():
        with Reporter() as reporter:
            result = calibration.calibrate(path, config, **how, watch=reporter.watch)
        found[path.resolve().name] = str(config.algo), result
        terminal.say(
            f"{path.resolve().name}: {figures.coverage(result)}, "
            f"{100 * result['crossing']:.0f} % of neighbours cross, rmse {result['rmse']:.3f}, spread {result['spread']:.3f}"
        )
    _write(out, lambda to: metrics.save_figure(figures.pit_histograms(found), to))
    statistics = {name: result for name, (_, result) in found.items()}
    _write(out.with_suffix(".json"), lambda to: files.write_json(to, statistics))
    terminal.say(f"written {out} and {out.with_suffix('.json').name}")
    return 0


def _write(path: Path, write) -> None:
    try:
        write(path)
    except OSError as reason:
        raise ConfigError(
            f"{path}: must be a file that can be written ({reason.strerror})"
        ) from reason


if __name__ == "__main__":
    sys.exit(main())
