"""Several trials in one compiled program: their settings are traced, so that one program trains them all at once."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optuna
from optuna.trial import Trial

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import to_dict
from dgae_jax.envs.base import Env
from dgae_jax.learn.build import (
    make_algorithm,
    make_task,
    make_train,
    make_trainer,
    policies_of,
    seed_keys,
)
from dgae_jax.learn.memory import check_memory
from dgae_jax.learn.parallel import COMPILER_OPTIONS, over_seeds
from dgae_jax.learn.types import TrainState
from dgae_jax.run import files, runtime
from dgae_jax.run.evaluation import evaluate_policies
from dgae_jax.run.options import RunOptions
from dgae_jax.run.runtime import Signals, Stopped, compile_in_thread
from dgae_jax.study.storage import first_number
from dgae_jax.study.tuning import Tuning, quarter, value_of


def make_step(env: Env) -> Callable[[ResolvedConfig, TrainState], TrainState]:
    """`step(configs, states) -> states`: an iteration of every trial [B] and seed [S]; the buffers of the states are donated."""

    def one(config: ResolvedConfig, state: TrainState) -> TrainState:
        return over_seeds(
            make_train(make_algorithm(str(config.algo), env, config), env, config)[1]
        )(state)[0]

    return jax.jit(jax.vmap(one), donate_argnums=1, compiler_options=COMPILER_OPTIONS)


def stacked(trees: list[Any]) -> Any:
    """One tree with a leading axis of trials."""
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x) for x in leaves]), *trees)


def train(
    tuning: Tuning, study: optuna.Study, trials: list[Trial], signals: Signals
) -> list[float | None]:
    """The value of each trial, None where it was pruned or broke down. Raises Stopped when a signal came: then all is lost."""
    configs = [tuning.config_of(trial.params) for trial in trials]
    runtime.use_devices(configs[0], RunOptions(devices=1, num_processes=1))
    runtime.use_cache(tuning.options.cache_dir)
    env, keys, settings = make_task(configs[0]), seed_keys(configs[0]), stacked(configs)
    check_memory(
        dataclasses.replace(configs[0], num_seeds=len(configs) * tuning.seeds),
        env,
        runtime.available_memory(),
    )
    init, step = make_trainer(env, 1).init, make_step(env)
    with signals.may_stop() as watch:
        compile_in_thread(init, configs[0], keys, watch=watch)
        states = stacked(
            [init(config, keys) for config in configs]
        )  # one after the other: see parallel.in_turn
        compile_in_thread(step, settings, states, watch=watch)
    options = (
        tuning.options
    )  # no trial's network differs in shape, so that one program evaluates them all
    evaluate = partial(
        evaluate_policies, config=configs[0], engine=options.eval_engine, episodes=options.episodes
    )
    every, results = quarter(configs[0]), [dict[str, Any]() for _ in trials]
    alive, total = set(range(len(trials))), configs[0].iterations
    for done in range(1, total + 1):
        states = jax.block_until_ready(step(settings, states))
        if signals.received:
            raise Stopped
        alive -= _broken(states, tuning.options)
        if not alive:
            break
        if done % every == 0 or done == total:
            for i in sorted(alive):
                with signals.may_stop() as watch:
                    results[i] = evaluate(
                        jax.tree.map(lambda x, i=i: x[i], policies_of(states)), watch=watch
                    )
        if done % every == 0 and done < total:
            alive -= {i for i in alive if _is_hopeless(trials[i], results[i], done // every)}
    return [
        _finish(tuning, study, trials[i], configs[i], results[i]) if i in alive else None
        for i in range(len(trials))
    ]


def _broken(states: TrainState, options: RunOptions) -> set[int]:
    return {
        i
        for i, failures in enumerate(states.failures)
        if int(failures.max()) >= options.max_nonfinite
    }


def _is_hopeless(trial: Trial, result: dict[str, Any], quarters: int) -> bool:
    trial.report(value_of(result), quarters)
    return trial.should_prune()


def _finish(
    tuning: Tuning,
    study: optuna.Study,
    trial: Trial,
    config: ResolvedConfig,
    result: dict[str, Any],
) -> float | None:
    """Leave settings and evaluation in the trial's directory."""
    here = tuning.directory / "trials" / f"{first_number(study, trial):04d}"
    here.mkdir(parents=True, exist_ok=True)
    files.write_json(here / "evaluation.json", result)
    files.write_json(here / "config.json", to_dict(config))
    value = value_of(result)
    return value if math.isfinite(value) else None
