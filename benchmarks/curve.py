"""Draw the learning curve of several runs, or of the numbers taken from them: python benchmarks/curve.py FILE.jsonl

With run directories behind it, `FILE.jsonl` is written first: per run and iteration `steps`, `seed` and `episode_return`, per
evaluation `steps`, `seed`, `return_mean` and `return_std`. The picture is `FILE.png`.
"""

import argparse
from pathlib import Path

import numpy as np

from dgae_jax.run import curve, files, metrics

TRAINING, EVALUATION = ("steps", "seed", "episode_return"), ("steps", "seed", "return_mean", "return_std")


def collect(runs: list[Path], path: Path) -> None:
    """Take from the runs what is drawn."""
    sources = ((run / name, kept) for name, kept in (("metrics.jsonl", TRAINING), ("evaluations.jsonl", EVALUATION)) for run in runs)
    rows = [{k: row[k] for k in kept} for path, kept in sources for row in metrics.read(path)]
    files.replace(path, files.json_lines(rows))


def draw(path: Path, title: str) -> None:
    rows = metrics.read(path)
    training = [row for row in rows if "episode_return" in row]
    steps, seeds = (sorted({row[name] for row in training}) for name in ("steps", "seed"))
    at = {(row["steps"], row["seed"]): row["episode_return"] for row in training}
    returns = np.array([[at[s, seed] for seed in seeds] for s in steps], float)
    dots = np.array([[row[k] for k in ("steps", "return_mean", "return_std")] for row in rows if "return_mean" in row])
    curve.save(curve.learning_curve(np.array(steps), returns, title, dots), path.with_suffix(".png"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--title", default="hopper-v4, dppo, native")
    arguments = parser.parse_args()
    if arguments.runs:
        collect(arguments.runs, arguments.file)
    draw(arguments.file, arguments.title)
