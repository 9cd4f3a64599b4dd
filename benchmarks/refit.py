"""Calibration of value distributions that are fitted to finished policies.

    python benchmarks/refit.py --json benchmarks/results/refit.json \\
        --picture docs/images/calibration-refit.png

The policies are those of the table of results. Rows of the file are not fitted again.
"""

import itertools
import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro

from dgae_jax.report import figures
from dgae_jax.report.results import Row, read
from dgae_jax.run import checkpoint, directory, metrics, runtime
from dgae_jax.run.calibration import calibrate, refit


@dataclass(frozen=True)
class Arguments:
    """Policies to fit a distribution to."""

    sweep: Path = Path("results/tuned")
    """Sweep with the policies [path]."""
    algos: tuple[str, ...] = ("dppo",)
    """Algorithms."""
    tasks: tuple[str, ...] = ("ant", "hopper", "walker2d")
    """Tasks."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds."""
    json: Path | None = None
    """File to keep the numbers in [path]."""
    picture: Path | None = None
    """PNG with a histogram for each [path]."""


def row(sweep: Path, run: Row) -> dict:
    """Fit and calibrate one, in other episodes than those it was fitted to."""
    source = sweep / "policies" / f"{run.run}.msgpack"
    with TemporaryDirectory() as place:
        made = refit(source, directory.config_of(source), which="latest")
        file = Path(place) / source.name
        checkpoint.save_networks(file, *made)
        found = calibrate(file, made[0], which="latest")
    critic = f"refit to {run.algo.upper()}"
    return {"task": run.env, "critic": critic, "seed": run.seed, "return": run.final, **found}


def main() -> None:
    """Print a line for each policy."""
    arguments = tyro.cli(Arguments, description="Distributions fitted to finished policies.")
    file, known, shown = arguments.json, {}, {}
    if file and file.exists():
        known = {each["checkpoint"]: each for each in json.loads(file.read_text())["rows"]}
    runs = {f"{run.run}.msgpack": run for run in read(arguments.sweep).rows}
    for which in itertools.product(arguments.tasks, arguments.algos, arguments.seeds):
        name = "-".join(map(str, which)) + ".msgpack"
        if name not in known:
            known[name] = row(arguments.sweep, runs[name])
            if file:
                found = {"machine": runtime.hardware(), "rows": list(known.values())}
                file.write_text(json.dumps(found, indent=1) + "\n")
        found = known[name]
        shown[name.removesuffix(".msgpack")] = which[1], found
        print(
            f"{name:28s}{found['coverage_90']:6.1%} in 90 %, CRPS {found['crps']:.3f}", flush=True
        )
    if arguments.picture:
        metrics.save_figure(figures.pit_histograms(shown), arguments.picture)


if __name__ == "__main__":
    main()
