"""The returns that came: episodes of the policy as it acts while training, each followed until further rewards do not count."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from dgae_jax.configs.config import invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.base import has_limit
from dgae_jax.learn.build import make_policy, make_task
from dgae_jax.learn.iteration import acting
from dgae_jax.learn.rollout import Episodes, rollout, start
from dgae_jax.learn.types import InferenceState, Transition
from dgae_jax.maths.returns import lambda_sum
from dgae_jax.run.compiling import Watch, compile_aside, unwatched

CHUNK = 100
"""Steps between looks at signals and clock."""

LEFT_OUT = 0.01
"""Weight γᵏ of the first reward that the return from a state leaves out, unless the episode ends before."""

LONGEST = 50_000
"""Most steps that a return is followed for."""


class Outcomes(NamedTuple):
    """What N worlds showed of a policy in T steps, through which its episodes go on without a time limit."""

    obs: Float[Array, "T N O"]
    reward: Float[Array, "T N"]
    discount: Float[Array, "T N"]
    """γ, and 0 where the episode ended."""
    outcome: Float[Array, "T N"]
    """The discounted return from each state on, of rewards as they are."""


def steps_that_count(gamma: float) -> int:
    """How many rewards of a return have a weight γᵏ above `LEFT_OUT`, at most `LONGEST`."""
    return int(np.count_nonzero(gamma ** np.arange(LONGEST) > LEFT_OUT))


def check(config: ResolvedConfig) -> None:
    """Raise ConfigError where returns cannot be followed to their end: γ is too near 1, or the task cuts episodes short itself."""
    if steps_that_count(config.gamma) == LONGEST:
        raise invalid(
            "gamma",
            config.gamma,
            f"at most {LEFT_OUT ** (1 / LONGEST):.4f}, so that returns can be followed to their end",
        )
    if has_limit(make_task(config)):
        raise invalid(
            "env", config.env, "a task without a time limit of its own, which cuts returns short"
        )


def play(
    policy: InferenceState,
    config: ResolvedConfig,
    key: Key[Array, ""],
    worlds: int,
    watch: Watch = unwatched,
) -> Outcomes:
    """The outcomes of one policy in as many worlds, over `episode_length` steps, rounded up to whole chunks.

    Actions are drawn from the policy. Raises as `check`.
    """
    check(config)
    env = make_task(config)
    network = make_policy(env, config)

    @jax.jit
    @jax.default_matmul_precision("highest")  # as in training
    def go_on(
        policy: InferenceState, episodes: Episodes, keys: jax.Array
    ) -> tuple[Episodes, Transition]:
        return rollout(env, acting(network, policy), episodes, keys, episode_length=2**30)

    begin, draw = jax.random.split(key)
    episodes, seen, paid = (
        jax.jit(lambda keys: start(env, keys))(jax.random.split(begin, worlds)),
        [],
        [],
    )
    length = -(-(config.episode_length + steps_that_count(config.gamma)) // CHUNK)
    keys = jax.random.split(draw, (length, CHUNK, worlds))
    compile_aside(go_on, policy, episodes, keys[0], watch=watch, what="compiling")
    for i in range(length):
        watch(f"playing step {i * CHUNK:,} of {length * CHUNK:,} in {worlds} worlds")
        episodes, step = go_on(policy, episodes, keys[i])
        seen += [step.obs] if i * CHUNK < config.episode_length else []
        paid.append((step.reward, config.gamma * (1.0 - step.terminated)))
    obs, (reward, discount) = (
        jnp.concatenate(seen),
        (jnp.concatenate(part) for part in zip(*paid, strict=True)),
    )
    return Outcomes(obs, *(x[: len(obs)] for x in (reward, discount, lambda_sum(reward, discount))))
