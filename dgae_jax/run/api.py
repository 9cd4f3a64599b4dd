"""Runs from Python: train one, and take its policy out."""

import contextlib
import dataclasses
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.envs.base import Env
from dgae_jax.envs.registry import given
from dgae_jax.learn.build import make_greedy, make_quantiles, make_task
from dgae_jax.learn.types import InferenceState
from dgae_jax.run import checkpoint, directory, metrics, terminal, training
from dgae_jax.run.options import RunOptions
from dgae_jax.run.training import RunError


class Policy:
    """A trained policy: its mean action, and what its critic thinks. NumPy in and out."""

    def __init__(self, policy: InferenceState, critic: InferenceState, config: ResolvedConfig):
        """`policy` and `critic` of one run, without the axis of runs."""
        env = make_task(config)
        self.observation_size = int(env.observation_size)  # pyright: ignore[reportArgumentType]
        self._policy, self._critic = policy, critic
        self._greedy, self._quantiles = (
            jax.jit(make_greedy(env, config)),
            jax.jit(make_quantiles(env, config)),
        )

    def __call__(self, obs: Any) -> np.ndarray:
        """The action [..., A] in each observation [..., O]: the mean, within the actuators' range, as evaluations play it.

        Raises ValueError if the last axis is not that of an observation.
        """
        return self._each(self._greedy, self._policy, obs)

    def quantiles(self, obs: Any) -> np.ndarray:
        """The critic's quantiles [..., K] of the discounted return from each observation [..., O], K = 1 for a scalar critic.

        They are in the units that the critic was trained in: returns of scaled rewards with `normalize_rewards`.
        """
        return self._each(self._quantiles, self._critic, obs)

    def _each(self, function: Any, network: InferenceState, obs: Any) -> np.ndarray:
        """Leading axes are one to the compiled program, so that it is compiled again for another number of observations only."""
        obs = np.asarray(obs, np.float32)
        if obs.ndim == 0 or obs.shape[-1] != self.observation_size:
            raise ValueError(
                f"observations of shape {obs.shape}; the last axis must be {self.observation_size}"
            )
        out = np.asarray(function(network, obs.reshape(-1, self.observation_size)))
        return out.reshape(*obs.shape[:-1], out.shape[-1])


class Run(NamedTuple):
    """A finished run."""

    policy: Policy
    """The last policy, of the first seed."""
    metrics: list[dict[str, Any]]
    """The rows of `metrics.jsonl`: one per iteration and seed."""
    evaluation: dict[str, Any]
    """What `evaluation.json` holds."""
    directory: Path | None
    """The run directory, None if it was temporary."""


def train(
    config: ResolvedConfig,
    run_dir: str | Path | None = None,
    *,
    env: Env | None = None,
    quiet: bool = False,
    **options: Any,
) -> Run:
    """Train, evaluate and return the whole of a run, as the command line does.

    `env` is an environment of one's own, which takes the place of the task that `config` names; the run is recorded as one of
    `custom:` and the name of its class. Without `run_dir` it is written to a temporary directory and removed at the end. `options`
    are fields of `RunOptions` (`episodes=5`, `checkpoint_every=50_000`, `resume_or_start=True`, …); `quiet` prints nothing but
    warnings. Raises ConfigError for an invalid setting before anything is written, and RunError if the run ends early, by a signal
    too: its message says how to go on, from a directory that stays, even a temporary one.
    """
    names = [f.name for f in dataclasses.fields(RunOptions) if f.name not in ("run_dir", "resume")]
    for name in options:
        if name not in names:
            raise ConfigError(f"{name}: must be one of {', '.join(names)}")
    with terminal.silenced(quiet), given(env) as name, _directory(run_dir) as path:
        config = config if name is None else dataclasses.replace(config, env=name)
        chosen = RunOptions(run_dir=path, **options)
        evaluation = training.train(resolve(config), chosen).evaluation
        return Run(
            load_policy(path, env=env),
            metrics.read(path / "metrics.jsonl"),
            evaluation,
            None if run_dir is None else path,
        )


def load_policy(
    run_dir: str | Path, which: str = "latest", *, seed: int = 0, env: Env | None = None
) -> Policy:
    """The policy of a run's latest checkpoint, or of its best evaluation's (`which="best"`); `run_dir` may be a policy's file.

    `seed` is the index among the seeds trained side by side (`num_seeds`), `env` the object that `train` was given. Only networks and
    observation statistics are read. Raises ConfigError for an invalid argument or a directory that holds no run, CheckpointError if
    no checkpoint can be read.
    """
    with given(env) as name:
        config = resolve(directory.config_of(Path(run_dir)))
        if name not in (None, config.env):
            raise invalid("env", name, f"left out: {run_dir} is a run of {config.env}")
        return _load(Path(run_dir), config, which, seed)


def _load(run_dir: Path, config: ResolvedConfig, which: str, seed: int) -> Policy:
    if not (type(seed) is int and 0 <= seed < config.num_seeds):
        raise ConfigError(
            f"seed {seed}: must be a whole number from 0 to {config.num_seeds - 1}, the index of a trained seed"
        )
    found = checkpoint.load_networks(run_dir, config, which)
    policy, critic = jax.tree.map(lambda x: x[seed], (found.policy, found.critic))
    return Policy(policy, critic, config)


@contextlib.contextmanager
def _directory(run_dir: str | Path | None) -> Iterator[Path]:
    """`run_dir`, or a temporary directory that stays only if the run can be continued in it."""
    if run_dir is not None:
        yield Path(run_dir)
        return
    made = tempfile.mkdtemp(prefix="dgae_jax-")
    try:
        yield Path(made)
    except RunError:
        raise
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise
    shutil.rmtree(made, ignore_errors=True)
