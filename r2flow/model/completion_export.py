"""Export of completion to an `.onnx` that runs without r2flow: the points of a scan in, the
completed scan out.
"""

import json
from copy import deepcopy
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from r2flow.base.errors import InputError, check, require
from r2flow.base.files import write_file
from r2flow.base.noise import Draws
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.flow.maps import jump
from r2flow.generators import Sampler, TransferFlow, condition_of
from r2flow.generators.base import KNOWN, Generated
from r2flow.lidar.known import Ray
from r2flow.lidar.projection import image_to_points, unproject
from r2flow.lidar.sensors import Sensor, named_sensor
from r2flow.lidar.sight import Sight
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.export import (
    SLOW,
    Difference,
    Exported,
    difference,
    log,
    notes_of,
    traced,
    unfused,
)
from r2flow.samplers import Jump

_AXES = {"points": "N", "completed": "M", "measured": "M", "error_68": "M"}
_OUTPUTS = {
    "scan": "(2 or 1, H, W): range in metres, reflectance of [0, 1]; 0: no return",
    "completed": "(M, 4): x ahead, y left, z up in metres, reflectance",
    "measured": "(M,): whether the point is one of the input",
    "error_68": "(M,): metres within which the range is right in 68 %; 0: measured",
}


class _OneJump(Sampler):
    """`Jump` with steps=1, without times that a graph would compute."""

    needs = "map"

    def __call__(
        self, generator: Any, noise: Tensor, condition: Any, draws: Any, progress: Any
    ) -> Generated:
        start, end = noise.new_tensor([0, 1])
        return Generated.after(jump(generator.map(condition), start, noise, end), 1)


class _Completion(nn.Module):
    """Points of a scan, (N, 4), to the completed image and points, as `complete` with seed 0."""

    noise: Tensor

    def __init__(self, flow: TransferFlow, source: Sensor) -> None:
        super().__init__()
        self.flow = flow
        self.sight = Sight(source, flow.space.sensor)
        self.register_buffer("noise", Draws(0, [0]).start(flow.noise_shape))

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        space = self.flow.space
        image, state, xyz = self.sight(points)
        # The third channel, without a label, lets reflectance of only 0 count as not measured.
        images = torch.cat([image, torch.zeros_like(image[:1])])[None]
        condition = condition_of(space, images, state[None])
        generated = self.flow(self.noise, condition, sampler=_OneJump())
        x_1 = generated.x
        channels = 1 + space.encoding.reflectance
        known = condition[KNOWN][0, :channels] > 0
        scan = torch.where(known, image[:channels], space.decode(x_1)[0, :channels])
        # A scan without a return in view has nothing to complete.
        scan = scan * ((scan[:1] > 0) & (state == Ray.RETURN).any())
        rays = space.rays
        measured = state == Ray.RETURN
        xyz = torch.where(measured, xyz, unproject(scan[None, :1], rays)[0])
        strength = scan[1:2] if channels > 1 else torch.zeros_like(scan)
        assert generated.density is not None
        (error,) = generated.density.error(scan[None, :1], [0.68])
        order = (rays[1, 0] % (2 * pi)).argsort()
        values = torch.cat([xyz, strength, error, measured[None]])[..., order].flatten(1).mT
        returned = (scan[0][:, order] > 0).flatten().nonzero()[:, 0]
        values = values[returned]
        return scan, values[:, :4], values[:, 5] > 0, values[:, 4]


def export_completion(checkpoint: Checkpoint, path: str | Path, source: Sensor | str) -> Exported:
    """Write a transfer flow as an `.onnx` that completes a scan, as `Checkpoint.complete` does.

    The input is `points` (N, 4) float32: x ahead, y left, z up in metres, and reflectance of [0,
    1], throughout 0 if unknown. The outputs are `scan` (2 or 1, H, W), range in metres and
    reflectance, 0 without a return, `completed` (M, 4), its points as the input's, `measured` (M,)
    bool, which of these are points of the input, unchanged, and `error_68` (M,), the predicted
    error in metres (`Completed.error`). A scan without a return in view gives M = 0. A `.json`
    beside the file has its metadata: sensors, size, limits, weights.

    Args:
        checkpoint: Of the sensor of the completed scan (`Checkpoint.through`).
        source: Sensor of the points, or its name or YAML file.

    Raises:
        InputError: another suffix, generator or sampler, a sensor that already has all rays, or a
            missing package.
    """
    path = Path(path)
    flow = checkpoint.generator
    source = named_sensor(source)
    rows, columns = checkpoint.sensor.shape
    whole = source.shape[0] >= rows and source.resized(rows, columns).same_image(checkpoint.sensor)
    if not isinstance(flow, TransferFlow):
        raise InputError(f"{checkpoint.path} is no transfer flow, as densify: use `export`.")
    check(not flow.classes, f"{checkpoint.path} has labels, which no file completes: give densify.")
    check(path.suffix == ".onnx", f"a transfer flow is exported as .onnx, found {path}.")
    check(flow.sampler == Jump(steps=1), "only a transfer flow with the sampler jump is exported.")
    check(
        not whole, f"scans of {source.name} have all rows of {checkpoint.sensor}: give more rows."
    )
    require("an .onnx", "export", "onnx", "onnxscript", "onnxruntime")
    from r2flow.model.onnx_graphs import to_onnx

    log.info(SLOW)
    module = _Completion(deepcopy(flow.at(flow.space, numbered=False)), source)
    notes = notes_of(checkpoint, flow.sampler, None)
    notes |= {"source": source.described(), "outputs": _OUTPUTS}
    with unfused():
        program = traced(module, torch.zeros(1024, 4))
        model = to_onnx(program, ["points"], [*_OUTPUTS], _AXES)
    model.metadata_props.add(key="r2flow", value=json.dumps(notes))
    write_file(path, model.SerializeToString())
    write_file(path.with_suffix(".json"), json.dumps(notes))
    return Exported(path, notes)


def compare_completion(checkpoint: Checkpoint, exported: Exported, source: Sensor) -> Difference:
    """Compare the completed image of a simulated scan by the file and by the flow."""
    import onnxruntime

    image = open_scans("simulated:0", Reading(source), num=1).source[0]
    points = np.column_stack(image_to_points(image, source))
    session = onnxruntime.InferenceSession(exported.path, providers=["CPUExecutionProvider"])
    (found,) = session.run(["scan"], {"points": points})
    expected = checkpoint.complete(points, sensor=source, precision="32-true")[0]
    return difference(expected, torch.from_numpy(found)[None])
