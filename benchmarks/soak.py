"""Memory, open files and threads of `dgae train` over a long run, read from Linux's /proc.

    python benchmarks/soak.py --minutes 60 --run-dir runs/soak

The default run (DPPO on Hopper, `native`) trains until SIGTERM ends it. The exit code is 1 if it
crashed, or if the last quarter used more than the second: 5 % of memory, or any file or thread.
"""

import signal
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from dgae_jax.run import files, metrics

TRAIN = Path(__file__).parent.parent / "experiments" / "train.py"


@dataclass(frozen=True)
class Arguments:
    """The run, and how often it is measured."""

    run_dir: Path
    """Directory of the run, new; soak.jsonl in it gets the measurements [path]."""
    minutes: float = 60.0
    """Length of the run [min]."""
    every: float = 15.0
    """Time between measurements [s]."""


def measured(pid: int) -> dict[str, float]:
    """Return resident memory [MB], open files and threads of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines)
    memory, files = int(status["VmRSS"].split()[0]) / 1024, Path(f"/proc/{pid}/fd").iterdir()
    return {"rss": memory, "files": len(list(files)), "threads": int(status["Threads"])}


def main() -> int:
    arguments = tyro.cli(Arguments, description="Watch the memory of a long run.")
    argv = f"--run-dir {arguments.run_dir} --physics native --total-steps 1_000_000_000".split()
    process = subprocess.Popen([sys.executable, str(TRAIN), *argv], stdout=subprocess.DEVNULL)
    began, rows = time.monotonic(), []
    while (seconds := time.monotonic() - began) < 60 * arguments.minutes and process.poll() is None:
        time.sleep(arguments.every)
        if process.poll() is None and (arguments.run_dir / "metrics.jsonl").exists():
            row = {"seconds": round(seconds + arguments.every), **measured(process.pid)}
            files.append_rows(arguments.run_dir / "soak.jsonl", [row])
            rows.append(row)
    since = time.monotonic()
    process.send_signal(signal.SIGTERM)
    code, stopping = process.wait(), time.monotonic() - since
    if len(rows) < 4:
        print(f"error: the run ended with exit code {code}", file=sys.stderr)
        return 1
    steps = metrics.read(arguments.run_dir / "metrics.jsonl")[-1]["steps"]
    print(f"{steps:,} samples in {arguments.minutes:g} minutes")
    print(f"exit code {code}, {stopping:.1f} s after SIGTERM")
    grown = False
    for name, unit, slack in (("rss", " MB", 1.05), ("files", "", 1.0), ("threads", "", 1.0)):
        column = [row[name] for row in rows]
        quarter = len(column) // 4
        second = statistics.median(column[quarter : 2 * quarter])
        fourth = statistics.median(column[-quarter:])
        quarters = f"second quarter {second:,.0f}, last quarter {fourth:,.0f}"
        print(f"{name}: start {column[0]:,.0f}, {quarters}, end {column[-1]:,.0f}{unit}")
        grown |= fourth > slack * second
    return int(grown or code != 128 + signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
