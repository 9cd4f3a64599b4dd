"""One training iteration: networks, critics, updates, running statistics, rollouts, and their step.

`build` makes an algorithm from its row of names and a configuration; `iteration.make_train` is the
training step; `parallel` runs many steps per dispatch and many seeds at once.
"""

import dgae_jax.envs.base  # noqa: F401  Brax first from there; its running statistics are used here
