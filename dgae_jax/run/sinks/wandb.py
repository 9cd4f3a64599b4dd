"""Weights & Biases: files in RUN_DIR/wandb, sent while the run trains where there is a login and a network; one run per seed.

Steps are counted in samples. Its own counter, which may only grow, has two numbers for each of them, the metrics' and the
evaluation's; pictures come behind the last. The files of a resumed run that stayed offline are sent in their order by `wandb sync`.
WANDB_MODE, WANDB_PROJECT and WANDB_ENTITY say what they say elsewhere.
"""

import os
import secrets
import socket
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from dgae_jax.run import terminal
from dgae_jax.run.sinks.sink import Place, Row, Sink, name_of, numbers, scores, seeds_of, settings

SECONDS = 3.0
"""How long to wait for the server before the run stays offline."""


def begin(place: Place) -> Sink:
    """The run of each seed, begun or continued."""
    import wandb

    mode, last = _mode(), [place.kept]
    runs = {}
    for seed in seeds_of(place.config):
        name, known = name_of(place, seed), place.ids.setdefault(str(seed), secrets.token_hex(4))
        runs[seed] = wandb.init(
            dir=str(place.run_dir),
            project=os.environ.get("WANDB_PROJECT") or "dgae_jax",
            group=place.run_dir.resolve().name,
            name=name,
            id=known,
            resume=None if mode == "offline" else "allow",
            mode=mode,
            reinit="create_new",
            settings=wandb.Settings(silent=True, console="off"),
        )
        runs[seed].config.update(settings(place.config, seed), allow_val_change=True)
        runs[seed].define_metric("*", step_metric="steps")
        if mode == "online":
            terminal.say(f"{name} at {runs[seed].url}")

    def rows(rows: list[Row]) -> None:
        for row in rows:
            runs[row["seed"]].log({"steps": row["steps"], **numbers(row)}, step=2 * row["steps"])
            last[0] = row["steps"]

    def evaluations(rows: list[Row]) -> None:
        for row in rows:
            runs[row["seed"]].log({"steps": row["steps"], **scores(row)}, step=2 * row["steps"] + 1)

    def close(paths: list[Path], finished: bool) -> None:
        for run in runs.values():
            media = {
                path.name: (wandb.Image if path.suffix == ".png" else wandb.Video)(str(path))
                for path in paths
            }
            if media:
                run.log(media, step=2 * last[0] + 2)
            run.finish(exit_code=0 if finished else 1)

    return Sink(rows, evaluations, close)


def _mode() -> Any:
    """What the user said; otherwise online if it can be, since nobody may be there to answer for a login."""
    import wandb

    chosen = wandb.setup().settings
    if os.environ.get("WANDB_MODE") or chosen.mode != "online":
        return chosen.mode
    return "online" if _has_login(chosen.base_url) and _answers(chosen.base_url) else "offline"


def _has_login(server: str) -> bool:
    """Whether there is a key in the environment or in ~/.netrc, where `wandb login` puts it."""
    from requests.utils import get_netrc_auth

    return (
        any(os.environ.get(name) for name in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE"))
        or get_netrc_auth(server) is not None
    )


def _answers(server: str) -> bool:
    """Whether anything listens there, or at the proxy on the way."""
    from requests.utils import get_environ_proxies, select_proxy

    address = urlsplit(select_proxy(server, get_environ_proxies(server)) or server)
    try:
        socket.create_connection(
            (address.hostname, address.port or {"http": 80}.get(address.scheme, 443)), SECONDS
        ).close()
    except OSError:
        return False
    return True
