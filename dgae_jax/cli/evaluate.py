"""Judge trained policies and critics: `dgae evaluate`, `dgae calibrate` and `dgae refit`."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from dgae_jax.cli import parse
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import directory, files, terminal
from dgae_jax.run.options import RunOptions, engine_of


@dataclass(frozen=True, kw_only=True)
class PolicyArguments:
    """Choice of a policy among those of a run, and of what to write."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or the file of a policy [path]."""
    checkpoint: Literal["latest", "best"] = "latest"
    """latest, or best: by the evaluations during training; judge it with another --seed."""
    index: Annotated[int, parse.number(int, 0, 4095)] = 0
    """Which of the seeds that were trained together, from 0."""
    seed: Annotated[int, parse.number(int, 0, 2**31 - 1)] = 0
    """Seed of the episodes; no two seeds share an initial state [1]."""
    cache_dir: str = RunOptions.cache_dir
    """Cache of compiled programs; none disables it [path]."""
    out: Path | None = None
    """Where to write; by default in the run directory, or beside the policy's file [path]."""

    def config_of(self, source: Path) -> ResolvedConfig:
        """Return the configuration of a run; raise ConfigError for an unknown seed."""
        config = directory.config_of(source)
        if self.index >= config.num_seeds:
            raise invalid("index", self.index, f"below {config.num_seeds}, the seeds of {source}")
        return config

    def out_or(self, name: str) -> Path:
        """Return what to write: by default in the run directory, or beside the policy's file."""
        source = self.run_dir
        beside = source.with_name(f"{source.stem}-{name}")
        return self.out or (beside if source.is_file() else source / name)

    @contextlib.contextmanager
    def writing(self, out: Path, config: ResolvedConfig, kind: str = "file") -> Iterator[Any]:
        """Start JAX on one device, show progress, and write `out`."""
        with parse.writing(out, kind), terminal.Reporter() as reporter:
            from dgae_jax.run import runtime

            runtime.use_devices(config, RunOptions(devices=1, num_processes=1))
            runtime.use_cache(self.cache_dir)
            yield reporter.watch


def titles(paths: list[Path]) -> list[str]:
    """Return the names of the runs; their whole paths where two names are the same."""
    names = [path.resolve().name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


@dataclass(frozen=True, kw_only=True)
class EvaluateArguments(PolicyArguments):
    """Evaluate the deterministic policy of a run, and write evaluation-ENGINE.json."""

    engine: Literal["gymnasium", "native", "jax", "mjx", "mjx-warp"] | None = None
    """Evaluation env: gymnasium, or an engine; by default the first that the task has."""
    episodes: Annotated[int, parse.number(int, 1, 10_000)] = 20
    """Episodes per trained seed [episodes]."""
    index: tyro.conf.Suppress[int] = 0


@parse.command(EvaluateArguments)
def evaluate(args: EvaluateArguments) -> None:
    """Evaluate one run directory."""
    config = args.config_of(args.run_dir)
    engine = engine_of(config, args.engine)
    from dgae_jax.run import evaluation

    best = "-best" if args.checkpoint == "best" else ""
    out = args.out_or(f"evaluation-{engine}{best}.json")
    how = {"engine": engine, "episodes": args.episodes, "seed": args.seed}
    with args.writing(out, config) as watch:
        result = evaluation.evaluate_run(
            args.run_dir, config, which=args.checkpoint, watch=watch, **how
        )
        files.write_json(out, result)
    terminal.say(f"{evaluation.describe(result)}, {result['checkpoint']}; written to {out}")


@dataclass(frozen=True, kw_only=True)
class CalibrateArguments(PolicyArguments):
    """Compare the value distributions of critics with observed returns.

    calibration.png has a histogram per run, calibration.json their statistics.
    """

    others: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Further directories of runs, or files of policies [paths]."""


@parse.command(CalibrateArguments)
def calibrate(args: CalibrateArguments) -> None:
    """Write one picture and the statistics of all runs."""
    sources = [args.run_dir, *args.others]
    configs = [args.config_of(path) for path in sources]
    for path, config in zip(sources, configs, strict=True):
        if not config.critic.is_distribution:
            raise ConfigError(f"{path}: must be a run with a value distribution, not {config.algo}")
    out = args.out_or("calibration.png").with_suffix(".png")
    how = {"which": args.checkpoint, "index": args.index, "seed": args.seed}
    with args.writing(out, configs[0]) as watch:
        from dgae_jax.report import figures
        from dgae_jax.run import calibration, metrics

        found = {
            name: (config.algo, calibration.calibrate(path, config, watch=watch, **how))
            for name, path, config in zip(titles(sources), sources, configs, strict=True)
        }
        metrics.save_figure(figures.pit_histograms(found), out)
        statistics = {name: result for name, (_, result) in found.items()}
        files.write_json(out.with_suffix(".json"), statistics)
    for name, result in statistics.items():
        terminal.say(
            f"{name}: {figures.coverage(result)}, {100 * result['crossing']:.0f} % of neighbours "
            f"cross, rmse {result['rmse']:.3f}, spread {result['spread']:.3f}"
        )
    terminal.say(f"written {out} and {out.with_suffix('.json').name}")


@dataclass(frozen=True, kw_only=True)
class RefitArguments(PolicyArguments):
    """Fit a value distribution to the returns of a policy held fixed.

    refit.msgpack is the policy as it is with the new critic.
    """

    num_envs: Annotated[int, parse.number(int, 1, 10_000)] = 128
    """Envs, each played for the length of an episode; more fit the tails better [envs]."""


@parse.command(RefitArguments)
def refit(args: RefitArguments) -> None:
    """Fit one critic."""
    config = args.config_of(args.run_dir)
    out = args.out_or("refit.msgpack")
    own = out.resolve() == args.run_dir.resolve() or out.absolute().parent.name == "checkpoints"
    if own or out.suffix != ".msgpack":
        allowed = "a file named *.msgpack, neither the policy itself nor a checkpoint"
        raise invalid("out", out, allowed)
    with args.writing(out, config) as watch:
        from dgae_jax.run import calibration, checkpoint

        how = {"which": args.checkpoint, "index": args.index, "seed": args.seed}
        made = calibration.refit(args.run_dir, config, num_envs=args.num_envs, watch=watch, **how)
        checkpoint.save_networks(out, *made)
    terminal.say(f"written {out}")
