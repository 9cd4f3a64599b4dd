"""Critics whose quantiles cannot cross, another loss and another λ: what the policy returns, and how many returns the quantiles hold.

    python benchmarks/heads.py --json benchmarks/results/heads.json

Each is a setting of DPPO or a part of it that this file puts in the package's tables. Rows that the file has are not trained again.
"""

import dataclasses
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
from jaxtyping import Array, Float

import dgae_jax as dg
from dgae_jax.cli import parse
from dgae_jax.configs.parts import CRITICS, TARGETS, Part
from dgae_jax.configs.resolved import resolve
from dgae_jax.learn.critics import SR_LAMBDA, quantile
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
    """What to train."""

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
    """The CRPS over the targets, at the scale of the quantile loss: half the energy distance up to a constant of the target; no κ."""
    return 0.5 * quantiles.shape[-1] * jax.vmap(crps, (None, -1))(quantiles, target).mean(0)


def over_kappa(quantiles: Quantiles, target: Quantiles, *, kappa: float) -> Float[Array, "*batch"]:
    """The quantile-Huber loss as Dabney et al. 2018 have it, divided by κ."""
    return quantile_huber_loss(quantiles, target, kappa=kappa) / kappa


def mean_and_shape(
    quantiles: Quantiles, target: Quantiles, *, kappa: float
) -> Float[Array, "*batch"]:
    """As the loss of `ordered`, but with the whole weight on the shape, about the mean as it is."""
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
    """A quantile critic with `order` behind its network, fitted by `distance`."""
    plain = quantile(obs_size, kappa=kappa, **options)

    def predict(params: Params, obs: Array) -> Quantiles:
        return order(plain.predict(params, obs))

    def loss(params: Params, batch: Batch):
        return jnp.where(
            batch.valid, distance(predict(params, batch.obs), batch.target, kappa=kappa), 0
        ).mean(), {}

    return plain._replace(predict=predict, loss=loss)


OPTIONS, SHARP = CRITICS["quantile"].options, CRITICS["ordered"].options
CRITICS["sorted-before"] = Part(partial(head, order=jnp.sort), OPTIONS)
CRITICS["softplus"] = Part(head, OPTIONS)
CRITICS["crps"] = Part(partial(head, distance=mean_crps), OPTIONS)
CRITICS["scaled"] = Part(partial(head, order=jnp.asarray, distance=over_kappa), SHARP)
CRITICS["heavy"] = Part(partial(head, distance=mean_and_shape), SHARP)
TARGETS["lambda-0.99"] = Part(SR_LAMBDA._replace(lam=0.99))

GAP_BIAS = {"kind": "quantile", "kappa": 0.01, "epochs": 3}
MEASURED: dict[str, dict] = {
    "quantile": {"kind": "quantile"},
    "plain": GAP_BIAS,
    "clipped": GAP_BIAS | {"max_grad_norm": 0.005},
    "sorted": GAP_BIAS | {"kind": "sorted-before"},
    "softplus": GAP_BIAS | {"kind": "softplus"},
    "crps": GAP_BIAS | {"kind": "crps"},
    "lambda-0.99": GAP_BIAS | {"target": "lambda-0.99"},
    "scaled": {"kind": "scaled"},
    "heavy": {"kind": "heavy"},
    "heavy-0.01": {"kind": "heavy", "kappa": 0.01},
    "ordered": {"kind": "ordered"},
}
"""Settings of the critic in which each departs from the preset."""


def row(task: str, critic: str, seed: int, total_steps: int) -> dict:
    """Train and calibrate one."""
    start = dataclasses.replace(
        dg.preset("tuned", "dppo", "walker2d"), env=task
    )  # one setting for all tasks
    fitted = dataclasses.replace(start.critic, **MEASURED[critic])
    config = resolve(
        dataclasses.replace(
            start, physics="native", seed=seed, total_steps=total_steps, critic=fitted
        )
    )
    with TemporaryDirectory() as directory:
        run = dg.train(config, Path(directory) / "run", quiet=True)
        found = calibrate(Path(directory) / "run", config, which="latest")
    about = {"task": task, "critic": critic, "seed": seed, "total_steps": total_steps}
    return {**about, "return": run.evaluation["return_mean"], **found}


def main() -> None:
    """Print a line for each run."""
    arguments = parse.arguments(Arguments, description="Critics whose quantiles cannot cross.")
    file = arguments.json
    rows = json.loads(file.read_text())["rows"] if file and file.exists() else []
    known = {
        (each["task"], each["critic"], each["seed"], each["total_steps"]): each for each in rows
    }
    print(
        f"{'':26s}{'return':>8s}{'in 90 %':>9s}{'crossing':>10s}{'RMSE':>8s}{'spread':>8s}{'CRPS':>8s}"
    )
    for which in itertools.product(
        arguments.tasks, arguments.critics, arguments.seeds, [arguments.total_steps]
    ):
        if which not in known:
            known[which] = row(*which)
            if file:
                file.write_text(
                    json.dumps(
                        {"machine": runtime.hardware(), "rows": list(known.values())}, indent=1
                    )
                    + "\n"
                )
        found, (task, critic, seed, _) = known[which], which
        shares = f"{found['return']:8,.0f}{found['coverage_90']:9.0%}{found['crossing']:10.0%}"
        print(
            f"{task:9s}{critic:12s}{seed:5d}{shares}{found['rmse']:8.3f}{found['spread']:8.3f}{found['crps']:8.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
