"""From the checkpoints of a run directory to a training state or to what acting takes of one."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from dgae_jax.configs.config import invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import MAY_CHANGE, differences
from dgae_jax.learn.build import make_task, make_trainer, seed_keys
from dgae_jax.learn.types import InferenceState, TrainState
from dgae_jax.run import checkpoint, terminal
from dgae_jax.run.checkpoint import CheckpointError, DamagedError, MissingError
from dgae_jax.run.evaluations import EvaluationsFile

T = TypeVar("T")

CHOICES = ("latest", "best")
"""Which checkpoint: the latest whole one, or that of the best evaluation."""


class Trained(NamedTuple):
    """Policy and critic of every run in a checkpoint, with a leading axis of runs, and its file."""

    policy: InferenceState
    critic: InferenceState
    path: Path


def training_state(run_dir: Path, config: ResolvedConfig) -> tuple[TrainState, Path]:
    """All of the latest checkpoint that is whole, and its file; warns of damaged ones.

    Raises CheckpointError if there is none, or it is of another run than `config`.
    """
    return _newest(run_dir, partial(load_state, config=config))


def trained(source: Path, config: ResolvedConfig, which: str) -> Trained:
    """The networks of a run directory's latest checkpoint or its best, or of a file; nothing else in the file is looked at.

    Raises ConfigError if the best is asked for and nothing was evaluated, CheckpointError as `training_state`.
    """
    if which not in CHOICES:
        raise invalid("checkpoint", which, f"one of {', '.join(CHOICES)}")
    if source.is_file():
        if which != "latest":
            raise invalid("checkpoint", which, f"latest: {source} is a single one")
        return _load_networks(source, config)
    run_dir = source
    if which == "latest":
        return _newest(run_dir, partial(_load_networks, config=config))[0]
    steps = EvaluationsFile(run_dir / "evaluations.jsonl").best
    if steps is None:
        raise invalid("checkpoint", which, f"latest: {run_dir} has no evaluations")
    return _load_networks(run_dir / "checkpoints" / checkpoint.name_of(steps), config)


def kept(run_dir: Path, config: ResolvedConfig) -> Iterator[Trained]:
    """The networks of every checkpoint that a run keeps, oldest first; warns of damaged ones and leaves them out.

    Raises CheckpointError if there is none, or one is of another run than `config`.
    """
    paths = checkpoint.found(run_dir / "checkpoints")
    if not paths:
        raise _none(run_dir)
    for path in paths:
        try:
            yield _load_networks(path, config)
        except DamagedError as reason:
            terminal.warn(f"warning: {reason}; left out")


def reward_std(path: Path, config: ResolvedConfig) -> np.ndarray:
    """What the rewards of every run [S] were last divided by in the checkpoint at `path`; 1 without `normalize_rewards`.

    Raises CheckpointError for a file that does not say, as those of policies once did not.
    """
    if not config.normalize_rewards:
        return np.ones(config.num_seeds)
    part = _scale(_blank(config).reward_scale.returns.std)
    try:
        return np.asarray(checkpoint.load(path, part, part=True)["reward_scale"]["returns"]["std"])
    except MissingError:
        raise CheckpointError(
            f"{path}: does not say what rewards were divided by; dgae refit fits a critic that does"
        ) from None


def load_state(path: Path, config: ResolvedConfig) -> TrainState:
    """The training state in one file; raises as `checkpoint.load`, and CheckpointError if the file is not of this run."""
    _compare(path, config)
    state = checkpoint.load(path, _blank(config))
    for iteration in state.iteration:
        if path.name != checkpoint.name_of(int(iteration) * config.samples_per_iteration):
            raise CheckpointError(f"{path}: is renamed, it was saved after {iteration} iterations")
    return state


def in_new_episodes(state: TrainState, config: ResolvedConfig) -> TrainState:
    """The training state with every world at the beginning of an episode, as it is after no other number of iterations."""
    keys = jax.vmap(jax.random.fold_in)(seed_keys(config), state.iteration)
    new = make_trainer(make_task(config), 1).init(config, keys).episodes
    episodes = state.episodes._replace(env=new.env, steps=new.steps, total=new.total)
    scale = state.reward_scale._replace(discounted=jnp.zeros_like(state.reward_scale.discounted))
    return state._replace(episodes=episodes, reward_scale=scale)


def save_networks(path: Path, config: ResolvedConfig, networks: Trained, std: ArrayLike) -> None:
    """What acting and predicting takes as a file of its own, which `trained` and `reward_std` read; `std` as from the latter."""
    (policy, critic), stats = (networks.policy, networks.critic), networks.policy.obs_stats
    scale = _scale(jnp.asarray(std, jnp.float32)) if config.normalize_rewards else {}
    checkpoint.write(
        path, config, checkpoint.arrays_of(_networks(policy.params, critic.params, stats) | scale)
    )


def _networks(policy: Any, critic: Any, obs_stats: Any) -> dict[str, Any]:
    """As they are named in a training state."""
    return {
        "policy": {"params": policy},
        "critic": {"params": critic},
        "obs_stats": obs_stats,
    }


def _scale(std: Any) -> dict[str, Any]:
    """As it is named in a training state."""
    return {"reward_scale": {"returns": {"std": std}}}


def _load_networks(path: Path, config: ResolvedConfig) -> Trained:
    _compare(path, config)
    blank: Any = _blank(config)
    part = _networks(blank.policy.params, blank.critic.params, blank.obs_stats)
    got = checkpoint.load(path, part, part=True)
    policy, critic = (
        InferenceState(got[name]["params"], got["obs_stats"]) for name in ("policy", "critic")
    )
    return Trained(policy, critic, path)


def _compare(path: Path, config: ResolvedConfig) -> None:
    """Arrays of the same shapes may be of another run."""
    for name, (ours, theirs) in differences(config, checkpoint.config_of(path)).items():
        if name not in MAY_CHANGE:
            raise CheckpointError(f"{path}: is of another run, its {name} is {theirs}, here {ours}")


def _blank(config: ResolvedConfig) -> TrainState:
    """Shapes and dtypes of a state."""
    return jax.eval_shape(make_trainer(make_task(config), 1).init, config, seed_keys(config))


def _newest(run_dir: Path, read: Callable[[Path], T]) -> tuple[T, Path]:
    wrong = []
    for path in reversed(checkpoint.found(run_dir / "checkpoints")):
        try:
            result = read(path)
        except DamagedError as reason:
            wrong.append(str(reason))
            continue
        for each in wrong:
            terminal.warn(f"warning: {each}; linear_schedule back to {path.name}")
        return result, path
    raise CheckpointError("; ".join(wrong)) if wrong else _none(run_dir)


def _none(run_dir: Path) -> CheckpointError:
    return CheckpointError(f"{run_dir}: must hold a checkpoint; checkpoints/ has none")
