"""A file of throughput.py, heads.py or refit.py as a Markdown table: python benchmarks/table.py benchmarks/results/hopper-64.json"""

import json
import sys
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from statistics import fmean

PEER_OF = {
    "ppo": "PPO",
    "dppo": "PPO",
    "trpo": "TRPO",
    "dtrpo": "TRPO",
    "a2c": "A2C",
    "da2c": "A2C",
}
"""The peers' algorithm to compare with."""


def rival_of(row: dict, peers: list[dict]) -> dict | None:
    """The fastest layout of stable-baselines3, or sb3-contrib for TRPO, on the task of a row; None if it was not measured."""
    theirs = [
        peer
        for peer in peers
        if peer["name"].startswith("stable-baselines3")
        and (peer["task"], peer["width"], peer["algo"])
        == (row["task"], row["width"], PEER_OF[row["algo"]])
    ]
    return max(theirs, key=lambda peer: peer["steps_per_second"], default=None)


def table(found: dict) -> str:
    """Of whichever file it is."""
    return critics(found["rows"]) if "rows" in found else speeds(found)


def critics(rows: list[dict]) -> str:
    """A row per critic and task; the seeds of each in their order, and means over them."""
    lines = [
        "| critic | task | seeds | returns | % in the central 90 % | crossing | RMSE | spread | CRPS |",
        "|---|---|---|---|---|---:|---:|---:|---:|",
    ]
    order = list(dict.fromkeys(row["critic"] for row in rows))
    rows = sorted(rows, key=lambda row: (order.index(row["critic"]), row["task"], row["seed"]))
    for (critic, task), members in groupby(rows, itemgetter("critic", "task")):
        group = list(members)
        each = [
            (f"{row['seed']}", f"{row['return']:,.0f}", f"{100 * row['coverage_90']:.0f}")
            for row in group
        ]
        seeds, returns, held = (" · ".join(numbers) for numbers in zip(*each, strict=True))
        crossing, *errors = (
            fmean(row[name] for row in group) for name in ("crossing", "rmse", "spread", "crps")
        )
        means = " | ".join([f"{100 * crossing:.0f} %", *(f"{error:.3f}" for error in errors)])
        lines.append(f"| {critic} | {task.capitalize()} | {seeds} | {returns} | {held} | {means} |")
    return "\n".join(lines)


def speeds(found: dict) -> str:
    """A row per algorithm and engine, then every peer in its fastest layout."""
    lines = ["| | compile | steps/s | over the peer | of the roofline |", "|---|---|---|---|---|"]
    tasks = {(row["task"], row["width"]) for row in found["ours"]}
    for row in found["ours"]:
        rival = rival_of(row, found["peers"])
        over, most = (
            f"{row[x] / rival['steps_per_second']:.1f} ×" if rival else "–"
            for x in ("steps_per_second", "roofline")
        )
        where = f", {row['task'].title()}, 2 × {row['width']}" if len(tasks) > 1 else ""
        name = f"{row['algo'].upper()}, `{row['physics']}`{where}"
        share = row["steps_per_second"] / row["roofline"]
        lines.append(
            f"| {name} | {row['compile_seconds']:.1f} s | {row['steps_per_second']:,.0f} | {over} | {share:.2f} of {most} |"
        )
    fastest = {}
    for peer in sorted(found["peers"], key=lambda peer: peer["steps_per_second"]):
        fastest[peer["name"].split()[0], peer["task"], peer["width"], peer["algo"]] = peer
    lines += [
        f"| {peer['name']} | – | {peer['steps_per_second']:,.0f} | – | – |"
        for peer in fastest.values()
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(json.loads(Path(sys.argv[1]).read_text())))
