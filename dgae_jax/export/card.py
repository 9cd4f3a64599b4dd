"""The model card beside an exported policy: what it is, what it is worth, how it is used. It says what the run's files say, no more."""

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.export.facts import Facts
from dgae_jax.run.options import engines_of, eval_env_id

LICENCE = "Apache-2.0"
"""Of dgae_jax, and so of the programs that are copied beside a policy."""

NPZ = """\
`policy.npz` holds plain arrays, `policy.py` acts by them, with NumPy and nothing else:

```python
import numpy as np
from policy import Policy

policy = Policy("policy.npz")
obs = np.zeros((5, {observations}))
actions, quantiles = policy(obs), policy.quantiles(obs)  # [5, {actions}] and [5, {quantiles}]
```
"""

ONNX = """\
`policy.onnx` takes raw observations `obs` [batch, {observations}], float32, and gives `action` [batch, {actions}] and `quantiles`
[batch, {quantiles}]; the running normaliser and the actuators' range are inside. With ONNX Runtime:

```python
import numpy as np
import onnxruntime

session = onnxruntime.InferenceSession("policy.onnx", providers=["CPUExecutionProvider"])
obs = np.zeros((5, {observations}), np.float32)
actions, quantiles = session.run(["action", "quantiles"], {{"obs": obs}})
```
"""

GYMNASIUM = """\
`agent.py` plays the task, by the arrays in `policy.npz`. It needs `pip install "gymnasium[mujoco]"`, and no JAX:

    python agent.py --episodes 5

`--seed` decides the initial states, as in `dgae evaluate`; evaluations while training play those of its default, 0.
"""

USE = {"npz": NPZ, "onnx": ONNX, "gymnasium": GYMNASIUM}
"""How each export is used."""


def card(
    kind: str,
    arrays: Mapping[str, np.ndarray],
    config: ResolvedConfig,
    index: int,
    facts: Facts,
    which: str,
) -> str:
    """The text of `README.md` for the export `kind` of the checkpoint `which`."""
    sizes = {
        "observations": arrays["observation_mean"].size,
        "actions": arrays["action_low"].size,
        "quantiles": _quantiles(arrays),
    }
    task, engine = eval_env_id(config), engines_of(config)[0]
    chosen = ", episodes which chose this checkpoint" if which == "best" else ""
    rows = {
        "task": f"{task}, episodes of at most {int(arrays['episode_length']):,} steps, observations [{sizes['observations']}], "
        f"actions [{sizes['actions']}]",
        "algorithm": str(config.algo),
        "trained on": f"{config.task}, engine {config.physics}, seed {config.seed + index}",
        "noise in training": ", ".join(
            f"{where} {std:g}" for where, std in asdict(config.noise).items() if std
        ),
        "samples": facts.samples and f"{facts.samples:,}",
        f"return in {task} ({engine})": facts.returns
        and f"{facts.returns}, mean ± standard deviation{chosen}",
        "critic": f"{config.critic.kind} [{sizes['quantiles']}], of the discounted return (γ = {config.gamma:g}){_scale(config)}",
        "checkpoint": facts.checkpoint,
        "trained with": ", ".join(f"{name} {version}" for name, version in facts.versions.items()),
        "git revision of dgae_jax": facts.git_revision,
        "licence": f"{LICENCE}, that of dgae_jax",
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items() if value)
    return (
        f"# {str(config.algo).upper()} on {task}\n\n"
        f"The deterministic policy of a run of dgae_jax, and what its critic predicts.\n\n| | |\n|---|---|\n{table}\n\n"
        f"## Use\n\n{USE[kind].format(**sizes)}"
    )


def _quantiles(arrays: Mapping[str, np.ndarray]) -> int:
    biases = [x for name, x in arrays.items() if name.startswith("critic_bias_")]
    return biases[-1].size


def _scale(config: ResolvedConfig) -> str:
    return (
        " of rewards divided by a standard deviation of returns" if config.normalize_rewards else ""
    )
