"""A policy's arrays as an ONNX model.

The model maps obs [batch, O] to action [batch, A] and quantiles [batch, K], all float32.
"""

from collections.abc import Mapping

import numpy as np

HEADER = '<ir_version: 7, opset_import: ["": 13], producer_name: "dgae_jax">'
"""Versions of 2020, which older runtimes read too."""


def serialize(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the bytes of an `.onnx` file with these arrays, checked by ONNX."""
    import onnx

    nodes = [
        "centered = Sub(obs, observation_mean)",
        "scaled = Div(centered, observation_std)",
        "normalized = Clip(scaled, observation_lowest, observation_limit)",
        *_network("policy", arrays, "mean"),
        "not_too_low = Max(mean, action_low)",  # Clip has one range for all actuators
        "action = Min(not_too_low, action_high)",
    ]
    constants = {name: x for name, x in arrays.items() if x.dtype == np.float32}
    constants["observation_lowest"] = -arrays["observation_limit"]
    if "critic_count" in arrays:
        constants["critic_count"] = arrays["critic_count"]
        nodes += [
            *_network("critic", arrays, "outputs"),
            "quantiles, ranks = TopK <axis = -1, largest = 0> (outputs, critic_count)",
        ]
    elif "critic_steps" in arrays:
        constants["critic_parts"] = np.array([1, len(arrays["critic_steps"])])
        nodes += [
            *_network("critic", arrays, "outputs"),
            "mean_return, raw_gaps = Split <axis = -1> (outputs, critic_parts)",
            "gaps = Softplus(raw_gaps)",
            "centered_cumsum = MatMul(gaps, critic_steps)",
            "quantiles = Add(mean_return, centered_cumsum)",
        ]
    else:
        nodes += _network("critic", arrays, "quantiles")
    *_, count = (x.size for name, x in arrays.items() if name.startswith("critic_bias_"))
    sizes = arrays["observation_mean"].size, arrays["action_low"].size, count
    obs, action, quantiles = (f"float[batch, {size}]" for size in sizes)
    graph = f"policy ({obs} obs) => ({action} action, {quantiles} quantiles)"
    model = onnx.parser.parse_model("\n".join([HEADER, graph, "{", *nodes, "}"]))
    model.graph.initializer.extend(
        onnx.numpy_helper.from_array(np.asarray(x), name) for name, x in constants.items()
    )
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _network(name: str, arrays: Mapping[str, np.ndarray], output: str) -> list[str]:
    *hidden, last = range(sum(key.startswith(f"{name}_weight_") for key in arrays))
    nodes, x = [], "normalized"
    for i in hidden:
        nodes += [
            f"{name}_linear_{i} = Gemm({x}, {name}_weight_{i}, {name}_bias_{i})",
            f"{name}_hidden_{i} = Tanh({name}_linear_{i})",
        ]
        x = f"{name}_hidden_{i}"
    return [*nodes, f"{output} = Gemm({x}, {name}_weight_{last}, {name}_bias_{last})"]
