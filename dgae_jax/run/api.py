"""Python API of runs: train one, load its policy."""

import dataclasses
import shutil
import tempfile
import uuid
from pathlib import Path
from typing import Any, Literal, NamedTuple, Unpack

import jax
import numpy as np

from dgae_jax.configs.config import Config, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.envs.base import Env
from dgae_jax.envs.registry import custom_env
from dgae_jax.learn.build import make_greedy, make_quantiles, make_task
from dgae_jax.learn.types import InferenceState
from dgae_jax.run import checkpoint, directory, metrics, terminal, training
from dgae_jax.run.options import RunOptions, TrainOptions


class Policy:
    """A trained policy: its mean action and its critic's quantiles, NumPy in and out."""

    def __init__(self, policy: InferenceState, critic: InferenceState, config: ResolvedConfig):
        """Compile the networks of one seed."""
        env = make_task(config)
        self.observation_size = int(env.observation_size)  # pyright: ignore[reportArgumentType]
        self._policy, self._critic = policy, critic
        self._greedy = jax.jit(make_greedy(env, config))
        self._quantiles = jax.jit(make_quantiles(env, config))

    def __call__(self, obs: Any) -> np.ndarray:
        """Return the mean actions [..., A] for observations [..., O], as evaluations play them.

        Raises:
            ValueError: the last axis is not that of an observation.
        """
        return self._apply(self._greedy, self._policy, obs)

    def quantiles(self, obs: Any) -> np.ndarray:
        """Return the critic's quantiles [..., K] of the discounted return; a scalar critic has one.

        With `normalize_rewards` they are of scaled rewards.
        """
        return self._apply(self._quantiles, self._critic, obs)

    def _apply(self, function: Any, network: InferenceState, obs: Any) -> np.ndarray:
        obs = np.asarray(obs, np.float32)
        if obs.ndim == 0 or obs.shape[-1] != self.observation_size:
            size = self.observation_size
            raise ValueError(f"observations of shape {obs.shape}; the last axis must be {size}")
        # one leading axis: compiled again for another number of observations only
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
    config: Config | ResolvedConfig,
    run_dir: str | Path | None = None,
    *,
    env: Env | None = None,
    quiet: bool = False,
    **options: Unpack[TrainOptions],
) -> Run:
    """Train and evaluate a run, as the command line does.

    Args:
        config: the configuration.
        run_dir: directory to write, new or empty; by default a temporary one, removed at the end.
        env: a custom env in place of the task that `config` names, recorded as `custom:CLASS`.
        quiet: print nothing but warnings.
        **options: fields of `RunOptions`, such as `episodes=5` or `resume_or_start=True`.

    Returns:
        The run, with its last policy.

    Raises:
        ConfigError: an invalid setting, before anything is written.
        RunError: the run ends early, by a signal too. The message says how to continue, from a
            directory that stays, even a temporary one.
    """
    temporary = Path(tempfile.gettempdir()) / f"dgae_jax-{uuid.uuid4().hex}"
    path = Path(run_dir or temporary)
    with terminal.silenced(quiet), custom_env(env) as name:
        config = config if name is None else dataclasses.replace(config, env=name)
        evaluation, _ = training.train(resolve(config), RunOptions(run_dir=path, **options))
        policy, rows = load_policy(path, env=env), metrics.read(path / "metrics.jsonl")
    if not run_dir:
        shutil.rmtree(temporary)
    return Run(policy, rows, evaluation, path if run_dir else None)


def load_policy(
    run_dir: str | Path,
    which: Literal["latest", "best"] = "latest",
    *,
    seed: int = 0,
    env: Env | None = None,
) -> Policy:
    """Load the policy of a run directory or a policy file.

    Args:
        run_dir: the directory, or the file.
        which: the latest checkpoint, or that of the best evaluation.
        seed: index among the seeds trained side by side (`num_seeds`).
        env: the custom env that `train` was given.

    Returns:
        The policy with its critic.

    Raises:
        ConfigError: an invalid argument, or a directory that holds no run.
        CheckpointError: no checkpoint can be read.
    """
    source = Path(run_dir)
    with custom_env(env) as name:
        config = directory.config_of(source)
        if name not in (None, config.env):
            raise invalid("env", name, f"left out: {run_dir} is a run of {config.env}")
        if not (type(seed) is int and 0 <= seed < config.num_seeds):
            raise invalid("seed", seed, f"an index below num_seeds ({config.num_seeds})")
        found = checkpoint.load_networks(source, config, which)
        policy, critic = jax.tree.map(lambda x: x[seed], (found.policy, found.critic))
        return Policy(policy, critic, config)
