"""Judge trained policies and critics: `dgae evaluate`, `dgae calibrate` and `dgae refit`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dgae_jax.cli import parse
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import directory, files, terminal
from dgae_jax.run.options import INTEGER_RANGES, RunOptions, engine_of


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Choice of a policy among those of a run."""

    checkpoint: Literal["latest", "best"] = "latest"
    """latest, or best: by the evaluations during training; judge it with another --seed."""
    index: int = 0
    """Which of the seeds that were trained together, from 0."""
    seed: int = 0
    """Seed of the episodes; no two seeds share an initial state [1]."""
    cache_dir: str = RunOptions.cache_dir
    """Cache of compiled programs; none disables it [path]."""

    def config(self, source: Path) -> ResolvedConfig:
        """Return the configuration of a run; raise ConfigError for an unknown seed."""
        config = directory.config_of(source)
        parse.check(
            self, index=(0, config.num_seeds - 1, f"the seeds of {source}"), seed=parse.INT32
        )
        return config


@dataclass(frozen=True, kw_only=True)
class EvaluateArguments(Choice):
    """Evaluate the deterministic policy of a run directory, or of a file.

    Examples:
      dgae evaluate runs/walker --episodes 100
      dgae evaluate runs/walker --checkpoint best --seed 7
      dgae evaluate policies/hopper-dppo-1.msgpack --engine native --out hopper.json
    """

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or the file of a policy [path]."""
    engine: Literal["gymnasium", "native", "jax", "mjx", "mjx-warp"] | None = None
    """Evaluation env: gymnasium, or an engine as in --physics of the training; by default the
    first that the task has."""
    episodes: int = 20
    """Episodes per trained seed [episodes]."""
    out: Path | None = None
    """File to write; by default evaluation-ENGINE.json or evaluation-ENGINE-best.json in the run
    directory, or beside the policy's file with its name in front [path]."""
    index: tyro.conf.Suppress[int] = 0


@parse.command(EvaluateArguments)
def evaluate(args: EvaluateArguments) -> None:
    """Evaluate one run directory."""
    parse.check(args, episodes=INTEGER_RANGES["episodes"])
    config = args.config(args.run_dir)
    from dgae_jax.run import evaluation

    engine = engine_of(config, args.engine)
    out = args.out or evaluation.default_path(args.run_dir, engine, args.checkpoint)
    parse.check_file(out)
    parse.use_one_device(config, args.cache_dir)
    how = {"engine": engine, "episodes": args.episodes, "seed": args.seed}
    with terminal.Reporter() as reporter:
        result = evaluation.evaluate_run(
            args.run_dir, config, which=args.checkpoint, watch=reporter.watch, **how
        )
    with parse.writing(out):
        files.write_json(out, result)
    terminal.say(f"{evaluation.describe(result)}, {result['checkpoint']}; written to {out}")


@dataclass(frozen=True, kw_only=True)
class CalibrateArguments(Choice):
    """Compare the value distributions of critics with observed returns.

    Examples:
      dgae calibrate runs/first
      dgae calibrate runs/first --checkpoint best --seed 1
      dgae calibrate runs/first runs/first/refit.msgpack --out calibration.png
    """

    run_dirs: tyro.conf.Positional[tuple[Path, ...]]
    """Directories of runs, or files of dgae refit and of policies [paths]."""
    out: Path | None = None
    """PNG with a histogram per run; their statistics go to a JSON file of the same name. By
    default calibration.png in the first directory, or beside its file [path]."""


@parse.command(CalibrateArguments)
def calibrate(args: CalibrateArguments) -> None:
    """Write one picture and the statistics of all runs."""
    configs, out = _check_calibrate(args)
    from dgae_jax.report import figures
    from dgae_jax.run import calibration, metrics

    parse.use_one_device(configs[0], args.cache_dir)
    for config in configs:
        calibration.check_returns(config)
    how = {"which": args.checkpoint, "index": args.index, "seed": args.seed}
    found = {}
    for path, config in zip(args.run_dirs, configs, strict=True):
        name = path.resolve().name
        with terminal.Reporter() as reporter:
            result = calibration.calibrate(path, config, watch=reporter.watch, **how)
        found[name] = config.algo, result
        terminal.say(
            f"{name}: {figures.coverage(result)}, {100 * result['crossing']:.0f} % of neighbours "
            f"cross, rmse {result['rmse']:.3f}, spread {result['spread']:.3f}"
        )
    with parse.writing(out):
        metrics.save_figure(figures.pit_histograms(found), out)
        statistics = {name: result for name, (_, result) in found.items()}
        files.write_json(out.with_suffix(".json"), statistics)
    terminal.say(f"written {out} and {out.with_suffix('.json').name}")


def _check_calibrate(args: CalibrateArguments) -> tuple[list[ResolvedConfig], Path]:
    """Return the configurations of the runs, and the picture to write."""
    if not args.run_dirs:
        raise ConfigError("RUN_DIRS: must be one run directory or more")
    names = [path.resolve().name for path in args.run_dirs]
    if len(set(names)) < len(names):
        raise ConfigError(f"RUN_DIRS {' '.join(names)}: must have different names")
    configs = [args.config(path) for path in args.run_dirs]
    for path, config in zip(args.run_dirs, configs, strict=True):
        if not config.critic.is_distribution:
            raise ConfigError(f"{path}: must be a run with a value distribution, not {config.algo}")
    out = args.out or files.beside(args.run_dirs[0], "calibration.png")
    if out.suffix != ".png":
        raise invalid("out", out, "a file named *.png")
    for file in (out, out.with_suffix(".json")):
        parse.check_file(file)
    return configs, out


@dataclass(frozen=True, kw_only=True)
class RefitArguments(Choice):
    """Fit a value distribution to the returns of a policy held fixed.

    Examples:
      dgae refit runs/first
      dgae refit runs/first --checkpoint best --num-envs 512 --out first.msgpack
      dgae refit results/tuned/policies/hopper-ppo-0.msgpack --out hopper.msgpack
    """

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or the file of a policy [path]."""
    num_envs: Annotated[int, tyro.conf.arg(aliases=("--worlds",))] = 128
    """Envs that are played for as many steps as an episode may have; more fit the tails better
    [envs]."""
    out: Path | None = None
    """File to write: the policy as it is with the new critic; by default refit.msgpack in the run
    directory, or beside the policy's file with its name in front [path]."""


@parse.command(RefitArguments)
def refit(args: RefitArguments) -> None:
    """Fit one critic."""
    parse.check(args, num_envs=(1, 10_000))
    config = args.config(args.run_dir)
    out = args.out or files.beside(args.run_dir, "refit.msgpack")
    parse.check_file(out)
    own = out.exists() and out.samefile(args.run_dir)
    if out.suffix != ".msgpack" or own or out.absolute().parent.name == "checkpoints":
        allowed = "a file named *.msgpack, neither the policy itself nor a checkpoint"
        raise invalid("out", out, allowed)
    from dgae_jax.run import calibration, checkpoint

    parse.use_one_device(config, args.cache_dir)
    how = {"which": args.checkpoint, "index": args.index, "seed": args.seed}
    with terminal.Reporter() as reporter:
        found = calibration.refit(
            args.run_dir, config, num_envs=args.num_envs, watch=reporter.watch, **how
        )
    with parse.writing(out):
        checkpoint.save_networks(out, found.config, found.networks, found.std)
    terminal.say(
        f"fitted to {found.returns:,} returns with a standard deviation of {found.std[0]:,.1f}; "
        f"written to {out}"
    )
