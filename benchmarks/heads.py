"""Critics with ordered quantiles, another loss or another λ: returns, and coverage of quantiles.

    python benchmarks/heads.py --json benchmarks/results/heads.json

Each is a setting of DPPO, or a part that this file registers. Rows of the file are not trained
again.
"""

import itertools
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import tyro
from jaxtyping import Array, Float

import dgae_jax as dg
from dgae_jax.configs.parts import CRITICS
from dgae_jax.learn.critics import TARGETS, quantile_critic
from dgae_jax.learn.types import Batch, Critic, Params
from dgae_jax.maths.statistics import crps
from dgae_jax.maths.transport import monotone_quantiles, quantile_huber_loss
from dgae_jax.run import runtime
from dgae_jax.run.calibration import calibrate

Quantiles = Float[Array, "*batch K"]
Name = Literal[
    "quantile",
    "plain",
    "clipped",
    "sorted",
    "softplus",
    "crps",
    "lambda-0.99",
    "scaled",
    "heavy",
    "heavy-0.01",
    "ordered",
]


@dataclass(frozen=True)
class Arguments:
    """Runs."""

    critics: tuple[Name, ...] = get_args(Name)
    """Critics, of `MEASURED`."""
    tasks: tuple[str, ...] = ("hopper",)
    """Tasks."""
    seeds: tuple[int, ...] = (1001, 1002)
    """Seeds, none of which is in the table of results."""
    total_steps: int = 1_000_000
    """Samples of a run [samples]."""
    json: Path | None = None
    """File to keep the numbers in [path]."""


def mean_crps(quantiles: Quantiles, target: Quantiles, *, kappa: float) -> Float[Array, "*batch"]:
    """Compute the CRPS over the targets, at the scale of the quantile loss; it has no κ."""
    return 0.5 * quantiles.shape[-1] * jax.vmap(crps, (None, -1))(quantiles, target).mean(0)


def over_kappa(quantiles: Quantiles, target: Quantiles, *, kappa: float) -> Float[Array, "*batch"]:
    """Compute the quantile-Huber loss over κ, as Dabney et al. 2018 have it."""
    return quantile_huber_loss(quantiles, target, kappa=kappa) / kappa


def mean_and_shape(
    quantiles: Quantiles, target: Quantiles, *, kappa: float
) -> Float[Array, "*batch"]:
    """Compute the loss of `ordered` with the whole weight on the shape, about the mean now."""
    mean = quantiles.mean(-1, keepdims=True)
    error = mean[..., 0] - target.mean(-1)
    return quantiles.shape[-1] / 4 * error**2 + over_kappa(
        quantiles - mean + jax.lax.stop_gradient(mean), target, kappa=kappa
    )


def head(
    obs_size: int,
    *,
    order: Callable = monotone_quantiles,
    distance: Callable = quantile_huber_loss,
    kappa: float,
    **options,
) -> Critic:
    """Build a quantile critic with `order` behind its network, fitted by `distance`."""
    plain = quantile_critic(obs_size, kappa=kappa, **options)

    def predict(params: Params, obs: Array) -> Quantiles:
        return order(plain.predict(params, obs))

    def loss(params: Params, batch: Batch):
        errors = distance(predict(params, batch.obs), batch.target, kappa=kappa)
        return jnp.where(batch.mask, errors, 0).mean(), {}

    return plain._replace(predict=predict, loss=loss)


OPTIONS, SHARP = CRITICS["quantile"], CRITICS["ordered"]
dg.register("critic", "sorted-before", partial(head, order=jnp.sort), OPTIONS)
dg.register("critic", "softplus", head, OPTIONS)
dg.register("critic", "crps", partial(head, distance=mean_crps), OPTIONS)
dg.register("critic", "scaled", partial(head, order=jnp.asarray, distance=over_kappa), SHARP)
dg.register("critic", "heavy", partial(head, distance=mean_and_shape), SHARP)
dg.register("target", "lambda-0.99", TARGETS["sr-lambda"]._replace(lam=0.99))

SHARPER = {"kind": "quantile", "kappa": 0.01, "epochs": 3}
MEASURED: dict[str, dict] = {
    "quantile": {"kind": "quantile"},
    "plain": SHARPER,
    "clipped": SHARPER | {"max_grad_norm": 0.005},
    "sorted": SHARPER | {"kind": "sorted-before"},
    "softplus": SHARPER | {"kind": "softplus"},
    "crps": SHARPER | {"kind": "crps"},
    "lambda-0.99": SHARPER | {"target": "lambda-0.99"},
    "scaled": {"kind": "scaled"},
    "heavy": {"kind": "heavy"},
    "heavy-0.01": {"kind": "heavy", "kappa": 0.01},
    "ordered": {"kind": "ordered"},
}
"""Settings of the critic that differ from the preset."""


def row(task: str, critic: str, seed: int, total_steps: int) -> dict:
    """Train and calibrate one, with one preset for all tasks."""
    changes = {"env": task, "physics": "native", "seed": seed, "total_steps": total_steps}
    changes |= {f"critic.{name}": value for name, value in MEASURED[critic].items()}
    config = dg.resolve(dg.preset("tuned", "dppo", "walker2d").replace(**changes))
    with TemporaryDirectory() as directory:
        run = dg.train(config, Path(directory) / "run", quiet=True)
        found = calibrate(Path(directory) / "run", config, which="latest")
    about = {"task": task, "critic": critic, "seed": seed, "total_steps": total_steps}
    return {**about, "return": run.evaluation["return_mean"], **found}


def main() -> None:
    """Print a line for each run."""
    arguments = tyro.cli(Arguments, description="Critics with ordered quantiles.")
    file = arguments.json
    rows = json.loads(file.read_text())["rows"] if file and file.exists() else []
    names = "task", "critic", "seed", "total_steps"
    known = {tuple(each[name] for name in names): each for each in rows}
    columns = "return", "in 90 %", "crossing", "RMSE", "spread", "CRPS"
    print(f"{'':26s}", *(f"{name:>8s}" for name in columns))
    for which in itertools.product(
        arguments.tasks, arguments.critics, arguments.seeds, [arguments.total_steps]
    ):
        if which not in known:
            known[which] = row(*which)
            if file:
                found = {"machine": runtime.hardware(), "rows": list(known.values())}
                file.write_text(json.dumps(found, indent=1) + "\n")
        found, (task, critic, seed, _) = known[which], which
        print(f"{task:9s}{critic:12s}{seed:5d}{found['return']:9,.0f}", end="")
        print(f"{found['coverage_90']:9.0%}{found['crossing']:9.0%}", end="")
        print(*(f"{found[name]:8.3f}" for name in ("rmse", "spread", "crps")), flush=True)


if __name__ == "__main__":
    main()
