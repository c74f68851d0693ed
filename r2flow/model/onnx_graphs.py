"""ONNX graphs of a flow; needs the extra `export`."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto
from onnx.compose import add_prefix
from onnx.helper import make_graph, make_model, make_node, make_tensor_value_info
from onnx.inliner import inline_local_functions
from onnx.numpy_helper import from_array, to_array
from onnx.parser import parse_function

# `r2flow.generators.surroundings._before` of `parts`, (L, B, blocks, W), in which row `l` of each
# block follows row `l - 1`; a sweep is repeated until the blocks' first rows stay, at most two
# turns. Bodies use their own inputs and constants alone: some runtimes know no others.
BEFORE = parse_function("""
<domain: "r2flow", opset_import: ["" : 18]>
Before <turning, ring> (parts, steps) => (offsets) {
  front = Constant <value = int64[1] {0}> ()
  two = Constant <value = int64[1] {2}> ()
  zero = Constant <value = float[1] {0}> ()
  true = Constant <value = bool {1}> ()
  log_zero = Log (zero)
  far = Neg (log_zero)
  turning_number = Constant <value_ints: ints = @turning> ()
  turns = Cast <to = 9> (turning_number)
  turn_wall = Where (turns, zero, far)
  ring_number = Constant <value_ints: ints = @ring> ()
  closed = Cast <to = 9> (ring_number)
  wall = Where (closed, zero, far)
  part = Gather (parts, front)
  both = Concat <axis = 0> (part, part)
  shape = Shape (both)
  start = Expand (far, shape)
  offsets_0 = Unsqueeze (start, front)
  blocks = Gather (shape, two)
  twice = Mul (blocks, two)
  most = Squeeze (twice)
  end, offsets = Loop (most, true, start, offsets_0) <body = sweeps (
    int64 number, bool going, float[2, b, k, w] state_0, float[l, 2, b, k, w] rows_0
  ) => (bool more, float[2, b, k, w] state_1, float[l, 2, b, k, w] rows_1) {
    last, wall_1, steps_1, rows_1 = Scan <num_scan_inputs = 1, body = row (
      float[2, b, k, w] state, float[1] wall_in, float[2, b, 1, 1] steps_in, bool[b, k, w] own
    ) => (
      float[2, b, k, w] next, float[1] wall_out, float[2, b, 1, 1] steps_out,
      float[2, b, k, w] same
    ) {
      begin = Constant <value = int64[1] {0}> ()
      one = Constant <value = int64[1] {1}> ()
      column = Constant <value = int64[1] {3}> ()
      back = Constant <value = int64[1] {-1}> ()
      before_back = Constant <value = int64[1] {-2}> ()
      beyond = Constant <value = int64[1] {2147483647}> ()
      none = Constant <value = float[1] {0}> ()
      moves = Constant <value = float[3,2,1,1,1] {-1, -1, -1, 0, -1, 1}> ()
      same = Identity (state)
      wall_out = Identity (wall_in)
      steps_out = Identity (steps_in)
      kept = Where (own, none, state)
      first_column = Slice (kept, begin, one, column)
      last_column = Slice (kept, back, beyond, column)
      left = Add (last_column, wall_in)
      right = Add (first_column, wall_in)
      wide = Concat <axis = 3> (left, kept, right)
      a = Slice (wide, begin, before_back, column)
      two_in = Constant <value = int64[1] {2}> ()
      c = Slice (wide, two_in, beyond, column)
      a_first = Unsqueeze (a, begin)
      b_first = Unsqueeze (kept, begin)
      c_first = Unsqueeze (c, begin)
      stay = Concat <axis = 0> (a_first, b_first, c_first)
      moved = Add (stay, moves)
      angles = Mul (moved, steps_in)
      squares = Mul (angles, angles)
      square = ReduceSum (squares, one)
      moved_0, moved_1, moved_2 = Split <axis = 0, num_outputs = 3> (moved)
      square_0, square_1, square_2 = Split <axis = 0, num_outputs = 3> (square)
      nearer_1 = Less (square_1, square_0)
      best_1 = Where (nearer_1, moved_1, moved_0)
      least = Min (square_1, square_0)
      nearer_2 = Less (square_2, least)
      best_2 = Where (nearer_2, moved_2, best_1)
      next = Squeeze (best_2, begin)
    }> (state_0, wall, steps, parts)
    block = Constant <value = int64[1] {2}> ()
    end_0 = Constant <value = int64[1] {0}> ()
    end_1 = Constant <value = int64[1] {-1}> ()
    end_2 = Constant <value = int64[1] {2147483647}> ()
    below = Slice (last, end_1, end_2, block)
    first = Add (below, turn_wall)
    others = Slice (last, end_0, end_1, block)
    state_1 = Concat <axis = 2> (first, others)
    equal = Equal (state_1, state_0)
    equal_number = Cast <to = 6> (equal)
    all = ReduceMin <keepdims = 0> (equal_number)
    all_equal = Cast <to = 9> (all)
    more = Not (all_equal)
  }>
}
""")


def to_onnx(
    program: torch.export.ExportedProgram,
    inputs: Sequence[str],
    outputs: Sequence[str],
    axes: Mapping[str, str] | None = None,
) -> onnx.ModelProto:
    """Convert a traced module to ONNX with these names; a first dimension that is not fixed is
    called as in `axes`, else `batch`.
    """
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
            sizes[0].dim_param = (axes or {}).get(value.name, "batch")
    for node in graph.node:
        del node.metadata_props[:]  # source locations in torch and r2flow
    if any(node.domain == BEFORE.domain for node in graph.node):
        model = _inlined(model)
    _shrink(model.graph)
    return model


def _shrink(graph: onnx.GraphProto) -> None:
    """Store large constants of one value as their shape and value."""
    uniform = []
    for constant in graph.initializer:
        values = to_array(constant)
        if values.size > 1024 and (values == values.flat[0]).all():
            uniform.append((constant, values))
    for constant, values in uniform:
        shape = from_array(np.array(values.shape), f"{constant.name}.shape")
        value = from_array(values.flat[:1])
        graph.node.insert(
            0, make_node("ConstantOfShape", [shape.name], [constant.name], value=value)
        )
        graph.initializer.remove(constant)
        graph.initializer.append(shape)


def _inlined(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with `BEFORE` in place of the nodes that call it."""
    function = model.functions.add()
    function.CopyFrom(BEFORE)
    versions = {opset.domain: opset for opset in model.opset_import}
    function.opset_import[0].CopyFrom(versions[""])
    model = inline_local_functions(model)
    del model.opset_import[:]
    model.opset_import.append(versions[""])
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
