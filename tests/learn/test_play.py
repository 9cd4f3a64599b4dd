"""Episodes that are only watched."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.learn.play import begin, play
from tests.probes import Counter


def still(obs):
    return jnp.zeros((*obs.shape[:-1], 1))


def worlds(env, key, count):
    return begin(jax.vmap(env.reset)(jax.random.split(key, count)))


def test_each_episode_is_summed_until_its_own_end(key):
    env = Counter(length=3)  # pays 1, 2, 3
    after = play(env, still, worlds(env, key, 6), 100)
    assert_allclose(after.total, [6.0] * 6)
    assert not after.alive.any()
    assert int(after.step) == 3  # not one step more than is needed


@pytest.mark.parametrize("chunk", [1, 3, 4, 9])
def test_in_chunks_of_any_size_the_same_episodes_are_played_up_to_the_limit(chunk, key):
    now = worlds(Counter(), key, 2)
    for until in range(chunk, 4 + chunk, chunk):
        now = play(Counter(), still, now, min(until, 4))
    assert_allclose(now.total, [1.0 + 2 + 3 + 4] * 2)
    assert_array_equal(now.alive, [True, True])
