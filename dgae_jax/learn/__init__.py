"""One training iteration: networks, critics, updates, running scales, rollouts, and the step that joins them."""

import dgae_jax.envs.base  # noqa: F401  Brax first from there; its running statistics are used here
