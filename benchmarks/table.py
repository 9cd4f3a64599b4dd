"""A file of throughput.py as a Markdown table: python benchmarks/table.py benchmarks/results/hopper-64.json"""

import json
import sys
from pathlib import Path

PEER_OF = {"ppo": "PPO", "dppo": "PPO", "trpo": "TRPO", "dtrpo": "TRPO", "a2c": "A2C", "da2c": "A2C"}
"""The peers' algorithm to compare with."""


def table(found: dict) -> str:
    """A row per algorithm and engine, then the peers' fastest."""
    lines = ["| | compile | steps/s | over the peer | of the roofline |", "|---|---|---|---|---|"]
    peers = {}
    for peer in found["peers"]:
        key = peer["task"], peer["width"], peer["algo"]
        peers[key] = max(peers.get(key, peer), peer, key=lambda p: p["steps_per_second"])
    for row in found["ours"]:
        rival = peers.get((row["task"], row["width"], PEER_OF[row["algo"]]))
        over = f"{row['steps_per_second'] / rival['steps_per_second']:.1f} ×" if rival else "–"
        lines.append(
            f"| {row['algo'].upper()}, `{row['physics']}` | {row['compile_seconds']:.1f} s | {row['steps_per_second']:,.0f} | {over} |"
            f" {row['steps_per_second'] / row['roofline']:.2f} |"
        )
    lines += [f"| {peer['name']} | – | {peer['steps_per_second']:,.0f} | 1 | – |" for peer in peers.values()]
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(json.loads(Path(sys.argv[1]).read_text())))
