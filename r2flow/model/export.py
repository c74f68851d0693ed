"""Export of a flow to a `.pt2` or `.onnx` that runs without r2flow: the network, or the sampler
(noise in, scan out).

A fixed-step sampler is linear in the noise and in the network's outputs. Its coefficients are
computed once, by running the generator with a recording network. The exported graph consists of the
coefficients, the network and the decoding.
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
from r2flow.base.errors import InputError, require
from r2flow.base.files import write_file
from r2flow.base.noise import Draws
from r2flow.base.registry import Config, Registry
from r2flow.generators import USUAL, RectifiedFlow, Sampler
from r2flow.lidar.encoding import ModelSpace
from r2flow.lidar.projection import unproject
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.saving import weights_hash

log = logging.getLogger(__name__)

SLOW = "torch exports the network: this takes up to some minutes"
NOTES = "r2flow.json"  # metadata file in a .pt2; an .onnx has the key `r2flow`


class Tableau(NamedTuple):
    """A sampler of E evaluations v_j, v(t_j, y_j) or u(y_j, t_j, s_j), at y_j = a_j0 x_0 +
    sum_{i<j} a_j,i+1 v_i.
    """

    times: list[float]  # t_j, (E,)
    second: list[float] | None  # s_j, (E,); None for a network of one time
    states: Tensor  # a, (E + 1, E + 1) float64; its last row makes x_1


class _Recorder(nn.Module):
    """Replaces a network: records the inputs of each call and returns the j-th vector for the j-th
    call.
    """

    def __init__(self, vectors: Tensor) -> None:
        super().__init__()
        self.vectors = vectors
        self.precision = nn.Parameter(torch.zeros((), dtype=torch.float64), requires_grad=False)
        self.calls: list[tuple[float, float, Tensor]] = []

    def forward(self, t: Any, x: Tensor, s: Any = None) -> Tensor:
        self.calls.append((float(t), float(t if s is None else s), x))
        return self.vectors[len(self.calls)].view_as(x)


def tableau(flow: RectifiedFlow, sampler: Sampler) -> Tableau:
    """Coefficients of a sampler."""
    sampler.check(flow)
    count = sampler.evaluations(flow)
    if count is None or sampler.draws or sampler.completes:
        raise InputError(
            f"sampler {sampler.name} cannot be exported, as it has no fixed steps of the ODE: give "
            "--sampler "
            f"{USUAL.name} --steps {USUAL.steps}."
        )
    units = torch.eye(count + 1, dtype=torch.float64)  # x_0 is the first unit vector
    others = 7 - 1000 * units
    rows, calls = _recorded(flow, sampler, units)
    if not torch.allclose(_recorded(flow, sampler, others)[0], rows @ others):
        raise InputError(
            f"{sampler.name} is not linear in the noise and the network's outputs here: it cannot "
            "be exported."
        )
    times, second, _ = zip(*calls, strict=True)
    rows = rows[:, : len(times) + 1]  # with `finish`, fewer than count
    return Tableau(list(times), list(second) if flow.second_time else None, rows)


def _recorded(
    flow: RectifiedFlow, sampler: Sampler, vectors: Tensor
) -> tuple[Tensor, list[tuple[float, float, Tensor]]]:
    """States of a sampler and x_1, (E + 1, N), from x_0 and network outputs that are the vectors,
    (E + 1, N).
    """
    recorder = _Recorder(vectors)
    shadow = copy(flow)
    shadow._modules = {**flow._modules, "backbone": recorder}
    x_1 = shadow(vectors[0].view(-1, 1, 1, 1), sampler=sampler).x
    return torch.stack([*(x for *_, x in recorder.calls), x_1]).flatten(1), recorder.calls


class _Decoded(nn.Module):
    """Decode x_1 to range in metres and reflectance, (B, 2 or 1, H, W), and points in metres, (B,
    3, H, W).
    """

    rays: Tensor

    def __init__(self, space: ModelSpace) -> None:
        super().__init__()
        self.space = space
        self.register_buffer("rays", space.sensor.rays())

    def forward(self, x_1: Tensor) -> tuple[Tensor, Tensor]:
        scan = self.space.decode(x_1)
        return scan, unproject(scan[:, :1], self.rays)


class _Scans(nn.Module):
    """x_0 to decoded scans, with all network evaluations unrolled."""

    def __init__(self, flow: RectifiedFlow, how: Tableau) -> None:
        super().__init__()
        self.network = flow.backbone
        self.decoded = _Decoded(flow.space)
        self.how = how

    def forward(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        *states, last = self.how.states.tolist()
        times = [values for values in (self.how.times, self.how.second) if values]
        vectors = [noise]
        for row, (t, *s) in zip(states, zip(*times, strict=True), strict=True):
            x = _weighted_sum(row, vectors)
            v = self.network(noise.new_tensor(t), x, *map(noise.new_tensor, s))
            vectors.append(v)
        return self.decoded(_weighted_sum(last, vectors))


def _weighted_sum(row: list[float], vectors: list[Tensor]) -> Tensor:
    return sum(a * v for a, v in zip(row, vectors, strict=False) if a)  # type: ignore[return-value]


class Exported(NamedTuple):
    path: Path
    notes: Config  # metadata


def export(
    checkpoint: Checkpoint,
    path: str | Path,
    sampler: Sampler | str | None = None,
    network: bool = False,
) -> Exported:
    """Write a rectified flow or a flow map as a `.pt2` (torch.export) or an `.onnx`.

    The input is `noise` (B, C, H, W). The outputs are `scan`, range in metres and reflectance, (B,
    2 or 1, H, W), 0 without a return, and `points` in metres, (B, 3, H, W), the origin without a
    return; float32. A `.pt2` unrolls all evaluations; an `.onnx` has the network once, in a loop.

    Args:
        path: Output file; its suffix sets the format.
        sampler: Sampler or its name; None: the flow's default.
        network: Export v(t, x) alone: `t` (B,) and `x` (B, C, H, W) to `v`; for a flow map also `s`
            (B,).

    Raises:
        InputError: an unknown suffix, another generator, a sampler that cannot be exported, a
            missing package, or a network that torch cannot export.
    """
    path = Path(path)
    flow = checkpoint.generator
    if not isinstance(flow, RectifiedFlow):
        raise InputError(
            f"only rectified flows and flow maps can be exported, and {checkpoint.path} holds a "
            f"{type(flow).__name__}."
        )
    if network and type(flow).velocity is not RectifiedFlow.velocity:
        raise InputError(
            f"v(t, x) of a {type(flow).__name__} is more than its network: export a sampler."
        )
    write = _FORMATS[path.suffix.removeprefix(".")]
    how = sampler if isinstance(sampler, Sampler) else flow.choose(sampler)
    steps = None if network else tableau(flow, how)
    if write is _write_onnx:
        require("an .onnx", "export", "onnx", "onnxscript", "onnxruntime")
    notes = notes_of(checkpoint, how, steps)
    log.info(SLOW)
    with unfused():
        data = write(deepcopy(flow), steps, notes)  # tracing moves and changes it
    write_file(path, data)
    return Exported(path, notes)


def notes_of(checkpoint: Checkpoint, how: Sampler, steps: Tableau | None) -> Config:
    space = checkpoint.generator.space
    notes = {
        "r2flow": __version__,
        "weights": weights_hash(checkpoint),
        "step": checkpoint.step,
        "image": list(space.shape),
        "sensor": space.sensor.described(),
        "encoding": checkpoint.config.model["encoding"],
    }
    if steps is None:
        return {**notes, "outputs": {"v": "dx/dt at x and t, of flow maps its mean from t to s"}}
    return {
        **notes,
        "sampler": how.asdict(),
        "evaluations": len(steps.times),
        "times": {"t": steps.times, "s": steps.second},
        "outputs": {
            "scan": "(batch, 2 or 1, H, W): range in metres, reflectance of [0, 1]; 0: no return",
            "points": "(batch, 3, H, W): x ahead, y left, z up in metres; origin: no return",
        },
    }


def _write_pt2(flow: RectifiedFlow, how: Tableau | None, notes: Config) -> bytes:
    if how is None:
        program = traced(flow.backbone, *_network_inputs(flow, (2,)))
    else:
        program = traced(_Scans(flow, how), torch.zeros(2, *flow.noise_shape))
    file = io.BytesIO()
    torch.export.save(program, file, extra_files={NOTES: json.dumps(notes)})
    return file.getvalue()


def _write_onnx(flow: RectifiedFlow, how: Tableau | None, notes: Config) -> bytes:
    from r2flow.model.onnx_graphs import sampler_graph, to_onnx

    inputs = _network_inputs(flow, (2,) if how is None else ())
    network = to_onnx(traced(flow.backbone, *inputs), ["t", "x", "s"][: len(inputs)], ["v"])
    if how is not None:
        decoded = traced(_Decoded(flow.space), torch.zeros(2, *flow.noise_shape))
        ends = to_onnx(decoded, ["x_1"], ["scan", "points"])
        network = sampler_graph(network, ends, how.times, how.second, how.states.numpy())
    network.metadata_props.add(key="r2flow", value=json.dumps(notes))
    return network.SerializeToString()


_FORMATS = Registry("export format", pt2=_write_pt2, onnx=_write_onnx)


def _network_inputs(flow: RectifiedFlow, shape: tuple[int, ...]) -> list[Tensor]:
    """Example inputs t, x and, for a flow map, s of the network, with times of shape () or (2,)."""
    x = torch.zeros(2, *flow.noise_shape)
    inputs = [torch.full(shape, 0.25), x, torch.full(shape, 0.5)]  # t, s: distinct tensors
    return inputs[: 2 + flow.backbone.second_time]


def traced(module: nn.Module, *inputs: Tensor) -> torch.export.ExportedProgram:
    batch = torch.export.Dim("batch", max=1 << 31)  # torch 2.6 refuses a size without a limit
    shapes = tuple({0: batch} if value.ndim else {} for value in inputs)
    module = module.cpu().eval()
    try:
        with torch.no_grad():
            # not strict: decisions in Python, such as the attention backend, are made now
            return torch.export.export(module, inputs, dynamic_shapes=shapes, strict=False)
    except Exception as error:  # torch raises nearly any exception here
        problem = str(error).strip().split("\n")[0]
        raise InputError(f"torch cannot export this {type(module).__name__}: {problem}") from None


@contextmanager
def unfused() -> Iterator[None]:
    """Disable fused operations, which runtimes may lack, and warnings of the exporters."""
    fast = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        torch.backends.mha.set_fastpath_enabled(fast)


class Difference(NamedTuple):
    """Difference between the scans of an exported file and those of the flow."""

    metres: float  # largest difference of range over rays with a return in both
    reflectance: float  # largest difference of reflectance over these rays; 0 without reflectance
    rays: int  # number of rays with a return in only one of them

    def __str__(self) -> str:
        return (
            f"range within {self.metres:.2g} m, reflectance within {self.reflectance:.2g}, "
            f"{self.rays} rays differ in ray-drop"
        )


def compare(
    checkpoint: Checkpoint, exported: Exported, sampler: Sampler | None = None, num: int = 2
) -> Difference:
    """Compare the first scans of seed 0 by the file and by the flow."""
    flow = checkpoint.generator
    noise = Draws(0, range(num)).start(flow.noise_shape)
    expected, _ = _Decoded(flow.space)(flow(noise, sampler=sampler).x)
    found = run(exported.path, noise)["scan"]
    return difference(expected, found)


def difference(expected: Tensor, found: Tensor) -> Difference:
    other = (expected[:, :1] > 0) != (found[:, :1] > 0)
    apart = (expected - found).abs().masked_fill(other, 0)
    reflectance = apart[:, 1:].max() if len(apart[0]) > 1 else 0.0
    return Difference(float(apart[:, 0].max()), float(reflectance), int(other.sum()))


def run(path: Path, noise: Tensor) -> dict[str, Tensor]:
    """Run an exported sampler: `scan` and `points`."""
    if path.suffix == ".pt2":
        with torch.no_grad(), warnings.catch_warnings(action="ignore"):
            outputs = torch.export.load(path).module()(noise)
    else:
        import onnxruntime

        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        outputs = map(torch.from_numpy, session.run(["scan", "points"], {"noise": noise.numpy()}))
    return dict(zip(("scan", "points"), outputs, strict=True))
