"""Batches made by hand."""

import jax.numpy as jnp

from dgae_jax.learn.types import Batch


def make_batch(obs, **fields):
    """A batch of these observations; fields that are not given are zeros, and nothing is masked."""
    size = obs.shape[:-1]
    zeros = jnp.zeros(size)
    batch = Batch(
        obs=obs,
        action=zeros[..., None],
        log_prob=zeros,
        advantage=zeros,
        value=zeros,
        target=zeros[..., None],
        reward=zeros,
        discount=zeros,
        next_obs=obs,
        mask=jnp.ones(size, bool),
    )
    return batch._replace(**fields)
