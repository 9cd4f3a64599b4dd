"""The arrays of a policy as an ONNX model: obs [batch, O] to action [batch, A] and quantiles [batch, K], float32, normaliser inside."""

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import numpy as np

from dgae_jax.configs.config import ConfigError

OPSET, IR_VERSION = 13, 7
"""Of 2020, so that runtimes which are not new read it too; it has all that the graph uses."""


def check_extra() -> None:
    """Raise ConfigError, saying what to install, unless the model can be made here."""
    if find_spec("onnx") is None:
        raise ConfigError(
            'onnx is not installed, which makes the model: pip install "dgae_jax[export]", or leave out --to onnx'
        )


def model(arrays: dict[str, np.ndarray], about: Mapping[str, str]) -> bytes:
    """The bytes of a file `.onnx`, checked by ONNX; `about` is what its metadata say, values by name."""
    import onnx
    from onnx import helper, numpy_helper

    limit = arrays["observation_limit"]
    constants = {name: x for name, x in arrays.items() if x.dtype == np.float32} | {
        "observation_lowest": -limit
    }
    if "critic_count" in arrays:
        constants["critic_count"] = arrays["critic_count"]
    if "critic_steps" in arrays:
        constants["critic_parts"] = np.array([1, len(arrays["critic_steps"])])
    nodes = [
        helper.make_node("Sub", ["obs", "observation_mean"], ["centred"]),
        helper.make_node("Div", ["centred", "observation_std"], ["scaled"]),
        helper.make_node(
            "Clip", ["scaled", "observation_lowest", "observation_limit"], ["normalised"]
        ),
        *_network("policy", arrays, "mean"),
        helper.make_node(
            "Max", ["mean", "action_low"], ["not_too_low"]
        ),  # Clip has one range for all actuators
        helper.make_node("Min", ["not_too_low", "action_high"], ["action"]),
        *_critic(arrays),
    ]
    quantiles = list(arrays[f"critic_bias_{_layers('critic', arrays) - 1}"].shape)
    graph = helper.make_graph(
        nodes,
        "policy",
        inputs=[_batch("obs", arrays["observation_mean"].shape)],
        outputs=[_batch("action", arrays["action_low"].shape), _batch("quantiles", quantiles)],
        initializer=[numpy_helper.from_array(np.asarray(x), name) for name, x in constants.items()],
    )
    made = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="dgae_jax",
    )
    helper.set_model_props(made, dict(about))
    onnx.checker.check_model(made, full_check=True)
    return made.SerializeToString()


def _layers(network: str, arrays: dict[str, np.ndarray]) -> int:
    return sum(name.startswith(f"{network}_weight_") for name in arrays)


def _network(network: str, arrays: dict[str, np.ndarray], output: str) -> list[Any]:
    """Its layers, with tanh between them."""
    from onnx import helper

    nodes, before, last = [], "normalised", _layers(network, arrays) - 1
    for i in range(last):
        linear, after = f"{network}_linear_{i}", f"{network}_hidden_{i}"
        nodes += [
            helper.make_node(
                "Gemm", [before, f"{network}_weight_{i}", f"{network}_bias_{i}"], [linear]
            )
        ]
        nodes += [helper.make_node("Tanh", [linear], [after])]
        before = after
    return [
        *nodes,
        helper.make_node(
            "Gemm", [before, f"{network}_weight_{last}", f"{network}_bias_{last}"], [output]
        ),
    ]


def _critic(arrays: dict[str, np.ndarray]) -> list[Any]:
    """Its network, whose mean and steps are made quantiles where it gives these, and whose outputs are sorted where they may cross."""
    from onnx import helper

    if "critic_count" in arrays:
        lowest = helper.make_node(
            "TopK", ["outputs", "critic_count"], ["quantiles", "ranks"], axis=-1, largest=0
        )
        return [*_network("critic", arrays, "outputs"), lowest]
    if "critic_steps" not in arrays:
        return _network("critic", arrays, "quantiles")
    return [
        *_network("critic", arrays, "mean_and_steps"),
        helper.make_node(
            "Split", ["mean_and_steps", "critic_parts"], ["mean_return", "log_steps"], axis=-1
        ),
        helper.make_node("Softplus", ["log_steps"], ["steps"]),
        helper.make_node("MatMul", ["steps", "critic_steps"], ["centered_cumsum"]),
        helper.make_node("Add", ["mean_return", "centered_cumsum"], ["quantiles"]),
    ]


def _batch(name: str, shape: Any) -> Any:
    from onnx import TensorProto, helper

    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *shape])
