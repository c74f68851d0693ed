"""ONNX graphs of a flow; needs the extra `export`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto
from onnx.compose import add_prefix
from onnx.helper import make_graph, make_model, make_node, make_tensor_value_info
from onnx.numpy_helper import from_array


def to_onnx(
    program: torch.export.ExportedProgram, inputs: Sequence[str], outputs: Sequence[str]
) -> onnx.ModelProto:
    """Convert a traced module to ONNX with these names; the first dimension is called `batch`."""
    converted = torch.onnx.export(
        program,
        (),
        dynamo=True,
        verbose=False,
        optimize=True,
        input_names=inputs,
        output_names=outputs,
    )
    assert converted is not None
    model: onnx.ModelProto = converted.model_proto
    graph = model.graph
    del graph.value_info[:]
    for value in (*graph.input, *graph.output):
        del value.metadata_props[:]
        sizes = value.type.tensor_type.shape.dim
        if len(sizes) and sizes[0].dim_param:
            sizes[0].dim_param = "batch"
    for node in graph.node:
        del node.metadata_props[:]  # source locations in torch and r2flow
    return model


def sampler_graph(
    network: onnx.ModelProto,
    decoded: onnx.ModelProto,
    times: Sequence[float],
    second: Sequence[float] | None,
    states: np.ndarray,
) -> onnx.ModelProto:
    """Graph from noise to scan and points: a loop over the sampler's evaluations, then the
    decoding.

    The loop state `known` stacks the noise and the network's outputs, with zeros for evaluations
    not yet made. `network` maps `t` (), `x` and, for a flow map, `s` () to `v`, and `decoded` maps
    `x_1` to `scan` and `points`; the other arguments are as in `r2flow.model.export.Tableau`.
    """
    network = add_prefix(network, "network.", rename_inputs=False, rename_outputs=False)
    decoded = add_prefix(decoded, "decoded.", rename_inputs=False, rename_outputs=False)
    count = len(times)
    constants = {
        "times": np.array(times, dtype=np.float32),
        "states": states.astype(np.float32),
        "numbers": np.arange(1 + count).reshape(-1, 1, 1, 1, 1),
        "evaluations": np.array(count),
        "true": np.array(True),
        "one": np.array(1),
        "flat": np.array([1 + count, -1]),
        "front": np.array([0]),
        "zero": np.array(0, dtype=np.float32),
    }
    if second:
        constants["second"] = np.array(second, dtype=np.float32)
    noise = onnx.ValueInfoProto()
    noise.CopyFrom(next(value for value in decoded.graph.input if value.name == "x_1"))
    noise.name = "noise"
    known = [
        1 + count,
        *(size.dim_param or size.dim_value for size in noise.type.tensor_type.shape.dim),
    ]
    nodes = [
        make_node("Shape", ["noise"], ["shape"]),
        make_node("Unsqueeze", ["noise", "front"], ["noise.first"]),
        make_node("Equal", ["numbers", "front"], ["first"]),
        make_node("Where", ["first", "noise.first", "zero"], ["known.0"]),
        make_node(
            "Loop",
            ["evaluations", "true", "known.0"],
            ["known.all"],
            body=_evaluation(network, second, known),
        ),
        *_state("evaluations", "known.all", "x_1"),
        *decoded.graph.node,
    ]
    initializers = [from_array(np.asarray(value), name) for name, value in constants.items()]
    initializers += [*network.graph.initializer, *decoded.graph.initializer]
    graph = make_graph(nodes, "sampler", [noise], list(decoded.graph.output), initializers)
    versions = {opset.domain: opset for model in (decoded, network) for opset in model.opset_import}
    model = make_model(graph, opset_imports=list(versions.values()), functions=[*network.functions])
    model.ir_version = network.ir_version
    return model


def _evaluation(
    network: onnx.ModelProto, second: Sequence[float] | None, known: list[Any]
) -> onnx.GraphProto:
    """Body of the loop: evaluation j of the network, whose output becomes entry j + 1 of the loop
    state.
    """
    second_time = [make_node("Gather", ["second", "j"], ["s"])] if second else []
    nodes = [
        make_node("Gather", ["times", "j"], ["t"]),
        *second_time,
        *_state("j", "known", "x"),
        *network.graph.node,
        make_node("Add", ["j", "one"], ["next"]),
        make_node("Equal", ["numbers", "next"], ["here"]),
        make_node("Unsqueeze", ["v", "front"], ["answer"]),
        make_node("Where", ["here", "answer", "known"], ["known.next"]),
        make_node("Identity", ["going"], ["going.next"]),
    ]
    inputs = [
        make_tensor_value_info("j", TensorProto.INT64, []),
        make_tensor_value_info("going", TensorProto.BOOL, []),
        make_tensor_value_info("known", 1, known),
    ]
    outputs = [
        make_tensor_value_info("going.next", TensorProto.BOOL, []),
        make_tensor_value_info("known.next", 1, known),
    ]
    return make_graph(nodes, "evaluation", inputs, outputs)


def _state(row: str, known: str, name: str) -> list[onnx.NodeProto]:
    """Nodes of the sum of `known`, weighted by a row of `states`."""
    return [
        make_node("Gather", ["states", row], [f"{name}.row"]),
        make_node("Reshape", [known, "flat"], [f"{name}.flat"]),
        make_node("MatMul", [f"{name}.row", f"{name}.flat"], [f"{name}.sum"]),
        make_node("Reshape", [f"{name}.sum", "shape"], [name]),
    ]
