"""A Markdown table from a file of throughput.py, heads.py or refit.py.

python benchmarks/table.py benchmarks/results/hopper-64.json
"""

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
"""Algorithm of the peers to compare with."""


def rival_of(row: dict, peers: list[dict]) -> dict | None:
    """Return the fastest layout of stable-baselines3 or sb3-contrib on the task of a row."""
    same = row["task"], row["width"], PEER_OF[row["algo"]]
    theirs = [
        peer
        for peer in peers
        if peer["name"].startswith("stable-baselines3")
        and (peer["task"], peer["width"], peer["algo"]) == same
    ]
    return max(theirs, key=itemgetter("steps_per_second"), default=None)


def table(found: dict) -> str:
    """Return the table of whichever file it is."""
    return critics(found["rows"]) if "rows" in found else speeds(found)


def critics(rows: list[dict]) -> str:
    """Return a row per critic and task: its seeds in order, and means over them."""
    columns = "critic | task | seeds | returns | % in the central 90 %"
    lines = [
        f"| {columns} | crossing | RMSE | spread | CRPS |",
        "|---|---|---|---|---|---:|---:|---:|---:|",
    ]
    order = list(dict.fromkeys(row["critic"] for row in rows))
    rows = sorted(rows, key=lambda row: (order.index(row["critic"]), row["task"], row["seed"]))
    for (critic, task), members in groupby(rows, itemgetter("critic", "task")):
        group = list(members)
        seeds = " · ".join(str(row["seed"]) for row in group)
        returns = " · ".join(f"{row['return']:,.0f}" for row in group)
        held = " · ".join(f"{100 * row['coverage_90']:.0f}" for row in group)
        names = "crossing", "rmse", "spread", "crps"
        crossing, *errors = (fmean(row[name] for row in group) for name in names)
        means = " | ".join([f"{100 * crossing:.0f} %", *(f"{error:.3f}" for error in errors)])
        lines.append(f"| {critic} | {task.capitalize()} | {seeds} | {returns} | {held} | {means} |")
    return "\n".join(lines)


def speeds(found: dict) -> str:
    """Return a row per algorithm and engine, then every peer in its fastest layout."""
    columns = "compile | steps/s | over the peer | share of the roofline | roofline over the peer"
    lines = [f"| | {columns} |", "|---|---|---|---|---|---|"]
    tasks = {(row["task"], row["width"]) for row in found["ours"]}
    for row in found["ours"]:
        rival, speed = rival_of(row, found["peers"]), row["steps_per_second"]
        over, most = (
            f"{x / rival['steps_per_second']:.1f} ×" if rival else "–"
            for x in (speed, row["roofline"])
        )
        where = f", {row['task'].title()}, 2 × {row['width']}" if len(tasks) > 1 else ""
        name = f"{row['algo'].upper()}, `{row['physics']}`{where}"
        share = f"{speed / row['roofline']:.2f} | {most}"
        lines.append(
            f"| {name} | {row['compile_seconds']:.1f} s | {speed:,.0f} | {over} | {share} |"
        )
    fastest = {}
    for peer in sorted(found["peers"], key=itemgetter("steps_per_second")):
        fastest[peer["name"].split()[0], peer["task"], peer["width"], peer["algo"]] = peer
    for peer in fastest.values():
        name = peer["name"].replace(", 1 threads", ", 1 thread")
        if peer["algo"] == "TRPO":
            name = name.replace("stable-baselines3", "sb3-contrib")
        lines.append(f"| {name} | – | {peer['steps_per_second']:,.0f} | – | – | – |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(json.loads(Path(sys.argv[1]).read_text())))
