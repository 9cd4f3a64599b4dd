"""Memory, file handles and threads of the real training command over a long run, read from Linux's /proc.

    python benchmarks/soak.py --minutes 60 --run-dir runs/soak

The default run (DPPO on Hopper, `native`, a checkpoint, an evaluation and a plot every 200,000 samples) goes on until a SIGTERM
ends it. Exit code 1 if it fell over, or if in the last quarter memory was more than 5 % or a handle above the second quarter.
"""

import signal
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from dgae_jax.cli import parse
from dgae_jax.run import files, metrics

TRAIN = Path(__file__).parent.parent / "experiments" / "train.py"


@dataclass(frozen=True)
class Arguments:
    """How long, and where."""

    run_dir: Path
    """Directory of the run, new; soak.jsonl in it gets the measurements [path]."""
    minutes: float = 60.0
    """Length of the run [min]."""
    every: float = 15.0
    """Time between measurements [s]."""


def measured(pid: int) -> dict[str, float]:
    """What a process holds now: resident memory [MB], open files, threads."""
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    handles = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return {
        "rss": int(status["VmRSS"].split()[0]) / 1024,
        "files": handles,
        "threads": int(status["Threads"]),
    }


def main() -> int:
    arguments = parse.arguments(Arguments, description="Watch the memory of a long run.")
    argv = [
        "--run-dir",
        str(arguments.run_dir),
        "--physics",
        "native",
        "--total-steps",
        "1_000_000_000",
    ]
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
        print(
            f"error: the run ended, with exit code {code}, before there were four measurements",
            file=sys.stderr,
        )
        return 1
    steps = metrics.read(arguments.run_dir / "metrics.jsonl")[-1]["steps"]
    print(
        f"{steps:,} samples in {arguments.minutes:g} minutes, then SIGTERM: exit code {code} after {stopping:.1f} s"
    )
    grown = False
    for name, unit, slack in (("rss", " MB", 1.05), ("files", "", 1.0), ("threads", "", 1.0)):
        column = [row[name] for row in rows]
        quarter = len(column) // 4
        second, fourth = (
            statistics.median(column[quarter : 2 * quarter]),
            statistics.median(column[-quarter:]),
        )
        shown = f"start {column[0]:,.0f}, second quarter {second:,.0f}, last quarter {fourth:,.0f}, end {column[-1]:,.0f}"
        print(f"{name}: {shown}{unit}")
        grown |= fourth > slack * second
    return int(grown or code != 128 + signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
