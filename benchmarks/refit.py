"""How many returns a value distribution holds that is fitted to a finished policy, and where in it they fall.

    python benchmarks/refit.py --json benchmarks/results/refit.json --picture docs/images/calibration-refit.png

The policies are those of the table of results, which keep what they return. Rows that the file has are not fitted again.
"""

import itertools
import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from dgae_jax.cli import parse
from dgae_jax.report import figures
from dgae_jax.report.results import Row, read
from dgae_jax.run import checkpoint, directory, metrics, runtime
from dgae_jax.run.calibration import calibrate, refit


@dataclass(frozen=True)
class Arguments:
    """Whose returns are fitted."""

    study: Path = Path("results/tuned")
    """Study with the policies [path]."""
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


def row(study: Path, cell: Row) -> dict:
    """TrainableState and calibrate one, in other episodes than those it was fitted to."""
    source = study / "policies" / f"{cell.run}.msgpack"
    with TemporaryDirectory() as place:
        made, file = (
            refit(source, directory.config_of(source), which="latest"),
            Path(place) / source.name,
        )
        checkpoint.save_networks(file, made.config, made.networks, made.std)
        found = calibrate(file, made.config, which="latest")
    about = {
        "task": cell.env,
        "critic": f"refit to {cell.algo.upper()}",
        "seed": cell.seed,
        "return": cell.final,
    }
    return {**about, **found}


def main() -> None:
    """Print a line for each policy."""
    arguments = parse.arguments(
        Arguments, description="Value distributions that are fitted to finished policies."
    )
    file, known, shown = arguments.json, {}, {}
    if file and file.exists():
        known = {each["checkpoint"]: each for each in json.loads(file.read_text())["rows"]}
    cells = {f"{cell.run}.msgpack": cell for cell in read(arguments.study).rows}
    for which in itertools.product(arguments.tasks, arguments.algos, arguments.seeds):
        name = "-".join(map(str, which)) + ".msgpack"
        if name not in known:
            known[name] = row(arguments.study, cells[name])
            if file:
                file.write_text(
                    json.dumps(
                        {"machine": runtime.hardware(), "rows": list(known.values())}, indent=1
                    )
                    + "\n"
                )
        shown[name.removesuffix(".msgpack")] = (which[1], known[name])
        print(
            f"{name:28s}{known[name]['coverage_90']:6.1%} in 90 %, CRPS {known[name]['crps']:.3f}",
            flush=True,
        )
    if arguments.picture:
        metrics.save_figure(figures.pit_histograms(shown), arguments.picture)


if __name__ == "__main__":
    main()
