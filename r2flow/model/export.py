"""Export of a flow to a `.pt2` or `.onnx` that runs without r2flow: the network, or the sampler (noise in, scan out).

A fixed-step sampler is linear in the noise and in the network's outputs. Its coefficients are computed once, by running
the generator with a recording network. The exported graph consists of the coefficients, the network and the decoding.
"""

import io
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy, deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from r2flow import __version__
from r2flow.errors import InputError, check, require
from r2flow.files import write_file
from r2flow.generators import USUAL, RectifiedFlow, Sampler
from r2flow.lidar.encoding import ModelSpace
from r2flow.lidar.projection import unproject
from r2flow.model.checkpoint import Checkpoint, weights_hash
from r2flow.noise import Draws
from r2flow.registry import Registry

NOTES = "r2flow.json"  # metadata file in a .pt2; an .onnx has the key `r2flow`


class Tableau(NamedTuple):
    """A sampler of E evaluations v_j, v(t_j, y_j) or u(y_j, t_j, s_j), at y_j = a_j0 x_0 + sum_{i<j} a_j,i+1 v_i."""

    times: list[float]  # t_j, (E,)
    second: list[float] | None  # s_j, (E,); None for a network of one time
    states: Tensor  # a, (E + 1, E + 1) float64; its last row makes x_1


class _Recorder(nn.Module):
    """Replaces a network: records the inputs of each call and returns the j-th vector for the j-th call."""

    def __init__(self, vectors: Tensor) -> None:
        super().__init__()
        self.vectors = vectors
        self.precision = nn.Parameter(torch.zeros((), dtype=torch.float64), requires_grad=False)
        self.calls: list[tuple[Tensor, ...]] = []

    def forward(self, t: Tensor | float, x: Tensor, s: Tensor | float | None = None) -> Tensor:
        self.calls.append((torch.as_tensor(t), x, torch.as_tensor(t if s is None else s)))
        check(len(self.calls) < len(self.vectors), "the sampler evaluates more often than its `evaluations` says.")
        return self.vectors[len(self.calls)].view_as(x)


def tableau(flow: RectifiedFlow, sampler: Sampler) -> Tableau:
    """Coefficients of a sampler."""
    sampler.check(flow)
    count = sampler.evaluations(flow)
    if count is None or sampler.draws or sampler.completes:
        what = "a condition" if sampler.completes else "noise at every step" if sampler.draws else "adaptive steps"
        raise InputError(
            f"sampler {sampler.name} needs {what} and cannot be exported: give --sampler {USUAL.name} --steps "
            f"{USUAL.steps}."
        )
    units = torch.eye(count + 1, dtype=torch.float64)  # x_0 is the first unit vector
    rows, calls = _recorded(flow, sampler, units)
    others = 7 - 1000 * units
    linear = torch.allclose(_recorded(flow, sampler, others)[0], rows @ others)
    check(linear, f"{sampler.name} is not linear in the noise and the network's outputs here: it cannot be exported.")
    times, _, second = zip(*calls, strict=True)
    rows = rows[:, : len(times) + 1]  # with `finish`, fewer than count
    return Tableau([float(t) for t in times], [float(s) for s in second] if flow.second_time else None, rows)


def _recorded(flow: RectifiedFlow, sampler: Sampler, vectors: Tensor) -> tuple[Tensor, list[tuple[Tensor, ...]]]:
    """States of a sampler and x_1, (E + 1, N), from x_0 and network outputs that are the vectors, (E + 1, N)."""
    recorder, shadow = _Recorder(vectors), copy(flow)
    shadow._modules = {**flow._modules, "backbone": recorder}
    x_1 = shadow(vectors[0].view(-1, 1, 1, 1), sampler=sampler).x
    return torch.stack([*(x for _, x, _ in recorder.calls), x_1]).flatten(1), recorder.calls


class Decoded(nn.Module):
    """Decode x_1 to range in metres and reflectance, (B, 2 or 1, H, W), and points in metres, (B, 3, H, W)."""

    rays: Tensor

    def __init__(self, space: ModelSpace) -> None:
        super().__init__()
        self.space = space
        self.register_buffer("rays", space.sensor.rays())

    def forward(self, x_1: Tensor) -> tuple[Tensor, Tensor]:
        scan = self.space.decode(x_1)
        return scan, unproject(scan[:, :1], self.rays)


class Scans(nn.Module):
    """x_0 to decoded scans, with all network evaluations unrolled."""

    def __init__(self, flow: RectifiedFlow, how: Tableau) -> None:
        super().__init__()
        self.network, self.decoded, self.how = flow.backbone, Decoded(flow.space), how

    def forward(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        *states, last = self.how.states.tolist()
        vectors = [noise]
        for j, row in enumerate(states):
            times = [noise.new_tensor(values[j]) for values in (self.how.times, self.how.second) if values]
            vectors.append(self.network(times[0], _sum(row, vectors), *times[1:]))
        return self.decoded(_sum(last, vectors))


def _sum(row: list[float], vectors: list[Tensor]) -> Tensor:
    x = row[0] * vectors[0]
    for a, v in zip(row[1:], vectors[1:], strict=False):
        x = x + a * v if a else x
    return x


class Exported(NamedTuple):
    """An exported file."""

    path: Path
    any_batch: bool  # whether the batch size is free; else 1
    notes: dict[str, Any]  # metadata


def export(
    checkpoint: Checkpoint, path: str | Path, sampler: Sampler | str | None = None, network: bool = False
) -> Exported:
    """Write a rectified flow or a flow map as a `.pt2` (torch.export) or an `.onnx`.

    The input is `noise` (B, C, H, W). The outputs are `scan`, range in metres and reflectance, (B, 2 or 1, H, W), 0
    without a return, and `points` in metres, (B, 3, H, W), the origin without a return; float32. A `.pt2` unrolls all
    evaluations; an `.onnx` has the network once, in a loop.

    Args:
        path: Output file; its suffix sets the format.
        sampler: Sampler or its name; None: the flow's default.
        network: Export v(t, x) alone: `t` (B,) and `x` (B, C, H, W) to `v`; for a flow map also `s` (B,).

    Raises:
        InputError: an unknown suffix, another generator, a sampler that cannot be exported, a missing package, or a
            network that torch cannot export.
    """
    path, flow = Path(path), checkpoint.generator
    if not isinstance(flow, RectifiedFlow):
        kind = type(flow).__name__
        raise InputError(f"only rectified flows and flow maps can be exported, and {checkpoint.path} holds a {kind}.")
    write, flow = FORMATS[path.suffix.removeprefix(".")], deepcopy(flow)  # which tracing moves and changes
    how = sampler if isinstance(sampler, Sampler) else flow.choose(sampler)
    own = type(flow).velocity is not RectifiedFlow.velocity
    check(not (network and own), f"v(t, x) of a {type(flow).__name__} is more than its network: export a sampler.")
    steps = None if network else tableau(flow, how)
    if write is _write_onnx:
        require("an .onnx", "export", "onnx", "onnxscript", *([] if network else ["onnxruntime"]))
    notes = _notes(checkpoint, how, steps)
    logging.getLogger(__name__).info("torch exports the network: this takes up to some minutes")
    with _quiet():
        data, any_batch = write(flow, steps, notes)
    write_file(path, data)
    return Exported(path, any_batch, notes)


def _notes(checkpoint: Checkpoint, how: Sampler, steps: Tableau | None) -> dict[str, Any]:
    flow = checkpoint.generator
    velocity = "mean velocity of x from t to s" if flow.second_time else "dx/dt at x and t"
    channels = ["range in metres", "reflectance of [0, 1]"][: 1 + flow.space.encoding.reflectance]
    scan = {
        "sampler": how.asdict(),
        "evaluations": steps and len(steps.times),
        "times": steps and {"t": steps.times, "s": steps.second},
        "outputs": {
            "scan": f"(batch, {len(channels)}, H, W): {', '.join(channels)}; 0 without a return",
            "points": "(batch, 3, H, W): x ahead, y left, z up in metres; the origin without a return",
        },
    }
    return {
        "r2flow": __version__,
        "weights": weights_hash(checkpoint),
        "step": checkpoint.step,
        "image": list(flow.space.shape),
        "sensor": flow.space.sensor.described(),
        "encoding": checkpoint.config["encoding"],
        **(scan if steps else {"outputs": {"v": f"{velocity}, in model space"}}),
    }


def _write_pt2(flow: RectifiedFlow, how: Tableau | None, notes: dict[str, Any]) -> tuple[bytes, bool]:
    noise = torch.zeros(2, *flow.noise_shape)
    module, inputs = (flow.backbone, _network_inputs(flow, (2,))) if how is None else (Scans(flow, how), [noise])
    program, any_batch = _traced(module, *inputs)
    file = io.BytesIO()
    torch.export.save(program, file, extra_files={NOTES: json.dumps(notes)})
    return file.getvalue(), any_batch


def _write_onnx(flow: RectifiedFlow, how: Tableau | None, notes: dict[str, Any]) -> tuple[bytes, bool]:
    from r2flow.model.onnx_graphs import sampler_graph, to_onnx

    program, any_batch = _traced(flow.backbone, *_network_inputs(flow, (2,) if how is None else ()))
    network = to_onnx(program, ["t", "x", "s"][: 2 + flow.backbone.second_time], ["v"])
    if how is not None:
        decoded, any_too = _traced(Decoded(flow.space), torch.zeros(2, *flow.noise_shape))
        any_batch = any_batch and any_too
        ends = to_onnx(decoded, ["x_1"], ["scan", "points"])
        network = sampler_graph(network, ends, how.times, how.second, how.states.numpy())
    network.metadata_props.add(key="r2flow", value=json.dumps(notes))
    network.producer_name, network.producer_version = "r2flow", __version__
    return network.SerializeToString(), any_batch


FORMATS = Registry("export format", pt2=_write_pt2, onnx=_write_onnx)


def _network_inputs(flow: RectifiedFlow, shape: tuple[int, ...]) -> list[Tensor]:
    """Example inputs t, x and, for a flow map, s of the network, with times of shape () or (2,)."""
    network = flow.backbone
    inputs = [torch.full(shape, 0.25), torch.zeros(2, network.in_channels, *network.coords.shape[2:])]
    return [*inputs, torch.full(shape, 0.5)] if network.second_time else inputs  # t, s: distinct tensors


def _traced(module: nn.Module, *inputs: Tensor) -> tuple[torch.export.ExportedProgram, bool]:
    """Export the module for a free batch size; if torch cannot, for one scan."""
    batch = torch.export.Dim("batch", max=1 << 31)  # torch 2.6 refuses a size without a limit
    module = module.cpu().eval()
    problem = ""
    for any_batch in (True, False):
        examples = tuple(value[:1] if value.ndim and not any_batch else value for value in inputs)
        dynamic_shapes = tuple({0: batch} if value.ndim and any_batch else {} for value in examples)
        try:
            with torch.no_grad():
                # not strict: decisions in Python, such as the attention backend, are made now
                return torch.export.export(module, examples, dynamic_shapes=dynamic_shapes, strict=False), any_batch
        except Exception as error:  # torch raises nearly any exception here
            problem = problem or str(error).strip().split("\n")[0]
    raise InputError(f"torch cannot export this {type(module).__name__}: {problem}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Disable fused operations, which runtimes may lack, and messages of the exporters."""
    fast, log = torch.backends.mha.get_fastpath_enabled(), logging.getLogger("torch.onnx")
    level = log.level
    torch.backends.mha.set_fastpath_enabled(False)
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        torch.backends.mha.set_fastpath_enabled(fast)
        log.setLevel(level)


class Difference(NamedTuple):
    """Difference between the scans of an exported file and those of the flow."""

    metres: float  # largest difference of range over rays with a return in both
    reflectance: float  # largest difference of reflectance over these rays; 0 without reflectance
    rays: int  # number of rays with a return in only one of them


def compare(checkpoint: Checkpoint, exported: Exported, sampler: Sampler | None = None, num: int = 2) -> Difference:
    """Compare the first scans of seed 0 by the file and by the flow."""
    flow = checkpoint.generator
    noise = Draws(0, range(num if exported.any_batch else 1)).start(flow.noise_shape)
    expected, _ = Decoded(flow.space)(flow(noise, sampler=sampler).x)
    exported_scans = run(exported.path, noise)["scan"]
    returned, returned_exported = expected[:, 0] > 0, exported_scans[:, 0] > 0
    both = returned & returned_exported
    largest = (expected - exported_scans).abs().movedim(1, 0)[:, both].amax(1).tolist() if both.any() else [0.0]
    return Difference(largest[0], sum(largest[1:]), int((returned != returned_exported).sum()))


def run(path: Path, noise: Tensor) -> dict[str, Tensor]:
    """Run an exported sampler: `scan` and `points`."""
    if path.suffix == ".pt2":
        with torch.no_grad(), warnings.catch_warnings(action="ignore"):
            scan, points = torch.export.load(path).module()(noise)
        return {"scan": scan, "points": points}
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, map(torch.from_numpy, session.run(names, {"noise": noise.numpy()})), strict=True))
