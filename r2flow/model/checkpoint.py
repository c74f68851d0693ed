"""Checkpoints: trained generators on disk, written atomically, checked on reading, without code
execution.
"""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from r2flow.backbones import BACKBONES
from r2flow.base.errors import IN_MEMORY, InputError, check, naming
from r2flow.base.files import reading_errors
from r2flow.base.plugins import made_with
from r2flow.data.described import Described, Spec, describe
from r2flow.data.detection import reading_for
from r2flow.data.options import FOLDER as PLAIN
from r2flow.data.options import SourceOptions
from r2flow.data.partial import PartialScan, open_partial
from r2flow.data.seeing import Sight, sight
from r2flow.generators import Generator, TransferFlow, build_generator
from r2flow.generators.calibration import Calibration
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.scan_files import Points, points_in_memory
from r2flow.lidar.sensors import Sensor, named_sensor
from r2flow.model.completer import Completer
from r2flow.model.completion import complete
from r2flow.model.config import ModelConfig
from r2flow.model.parts import HYPER, NOTES, PREFIX, config_of
from r2flow.model.paths import find_checkpoint, title_of
from r2flow.model.published import FORMATS
from r2flow.model.sampling import sample
from r2flow.model.saving import save_checkpoint
from r2flow.model.shipped import name_of
from r2flow.model.tensor_files import is_dense, read_checkpoint, read_safetensors
from r2flow.samplers import build_sampler


@dataclass(frozen=True, repr=False)
class Checkpoint:
    """A trained generator. `Checkpoint(generator, config)` wraps a generator that was trained
    without a run.

    Attributes:
        generator: The generator with its averaged weights, in eval mode.
        config: The config of its training; given as plain dicts, it becomes a `ModelConfig`.
        step: Optimiser steps taken.
        path: File that it was read from.
        format: `r2flow`, or `published` for files of the original implementations.
    """

    generator: Generator
    config: ModelConfig
    step: int = 0
    path: Path = Path("unsaved")
    format: str = "r2flow"
    chosen: bool = False  # whether its sensor was chosen by `through`, not by the training
    # By sensor: number of points, model and sight of the last scan that was new.
    _sights: dict[Any, Any] = field(default_factory=dict, init=False, compare=False)

    def __post_init__(self) -> None:
        if not isinstance(self.config, ModelConfig):
            object.__setattr__(self, "config", ModelConfig(self.config))

    def __repr__(self) -> str:
        kind = self.config.generator["name"]
        size = "x".join(map(str, self.sensor.shape))
        sensor = f"{size} {self.sensor.name}"
        return f"Checkpoint({title_of(self.path)}, {kind}, {sensor}, step {self.step})"

    @property
    def sensor(self) -> Sensor:
        """Sensor of the images."""
        return self.generator.space.sensor

    @property
    def encoding(self) -> Encoding:
        """Encoding between model space and metres."""
        return self.generator.space.encoding

    @property
    def model(self) -> Any:
        """The network v(t, x) of a flow; a flow map's also takes s."""
        return self.generator.backbone

    def sample(self, num: int = 1, seed: int = 0, **how: Any) -> Tensor:
        """Scans 0 to num - 1 of a seed: range in metres and reflectance, (num, 2 or 1, H, W), 0
        without a return.

        Args:
            how: Options of `r2flow.model.sampling.sample`: sampler, steps, batch_size, ...
        """
        return torch.cat([drawn.images for drawn in sample(self, num, seed, **how)])

    def complete(
        self,
        images: Tensor | np.ndarray | str | Path,
        state: Tensor | None = None,
        num: int = 1,
        seed: int = 0,
        *,
        sensor: Sensor | str | None = None,
        **how: Any,
    ) -> Tensor:
        """Complete partial scans, (B, num, 2 or 1, H, W), in the format of `sample`.

        Args:
            images: Range in metres and optionally reflectance, (B, 2 or 1, H, W), or the points of
                one scan of any sensor, (N, 3 or 4): x ahead, y left, z up, reflectance, or a scan
                file, or a folder of them.
            state: `r2flow.lidar.known.Ray` of each ray, (B, H, W); see
                `r2flow.model.completion.complete`. Rays of points are not measured where no beam
                looks.
            sensor: Sensor of the points, by name or YAML file; None: found by their beams.
            how: Options of `r2flow.model.completion.complete`: sampler, steps, batch_size, ...
        """
        if not isinstance(images, str | Path):
            shape = tuple(getattr(images, "shape", ()))
            right = (len(shape) == 4 and shape[0]) or (len(shape) == 2 and shape[1] in (3, 4))
            check(
                right,
                "give a path, images (B, 2 or 1, H, W) or points (N, 3 or 4); found "
                f"{shape or type(images)}.",
            )
            # a message's points: read-only or big-endian, which torch does not take
            if not isinstance(images, Tensor):
                images = torch.from_numpy(np.array(images, images.dtype.newbyteorder("=")))
        if isinstance(images, Tensor) and images.ndim == 2:
            check(state is None, "points have the states of their rays: give no state.")
            points = points_in_memory(images.detach().float().cpu().numpy())
            self, see = self._sight(points, sensor)
            one = see(Path(IN_MEMORY), points)
            images = torch.from_numpy(one.image)[None]
            state = torch.from_numpy(one.state)[None]
        elif isinstance(images, str | Path):
            check(state is None, "a scan file has the states of its rays: give no state.")
            self, scans, remarks = self.open_partial([str(images)], sensor)
            for lost in remarks[1:]:
                warnings.warn(lost.removeprefix(f"{images}: "), stacklevel=2)
            seen = [scan.read() for scan in scans]
            images = torch.from_numpy(np.stack([one.image for one in seen]))
            state = torch.from_numpy(np.stack([one.state for one in seen]))
        else:
            check(
                sensor is None,
                "images are of the model's sensor: give no sensor, or points of (N, 4).",
            )
        return torch.stack(
            [completed.images for completed in complete(self, images, state, num, seed, **how)]
        )

    def open_partial(
        self,
        specs: Sequence[Spec],
        sensor: Sensor | str | None = None,
        columns: Sequence[str] | None = None,
        keep_beams: bool = False,
        label_ids: str | None = None,
        **how: Any,
    ) -> "tuple[Checkpoint, list[PartialScan], list[str]]":
        """This model for the sensor of scans to complete, the scans, and remarks; see
        `r2flow.data.partial`.

        With `keep_beams`, a transfer flow takes the view of the scans if they are of one sensor
        that sees past its own.
        """
        named = None if sensor is None else named_sensor(sensor)
        reading = reading_for(
            [], self, columns=columns, labels=self.encoding.labels, label_ids=label_ids
        )
        described = [describe(spec) for spec in specs]
        scans, remarks = open_partial(described, reading, named, **how)
        transfers = isinstance(self.generator, TransferFlow)
        views = {scan.whole for scan in scans}
        if keep_beams and transfers and len(views) == 1 and (view := views.pop()):
            model, scans, remarks = self.through(view).open_partial(
                described, sensor, columns, label_ids=label_ids, **how
            )
            size = "x".join(map(str, view.shape))
            remarks.append(f"completed in their own view, as {size}, which keeps all their beams")
            return model, scans, remarks
        other = remarks and not all(map(self._coarser, described))
        return self._without_rows() if other else self, scans, remarks

    def _sight(self, points: Points, sensor: Sensor | str | None) -> "tuple[Checkpoint, Sight]":
        """This model for the sensor of points in memory, and how their points are seen.

        It is kept for scans of the same named sensor and about as many points: finding it takes
        longer than completing a scan.
        """
        number = len(points.xyz)
        known, *kept = self._sights.get(sensor, (0, self, None))
        if sensor is None or not 0.75 < known / number < 4 / 3:
            kept = [*self._seeing(points, sensor, keep_beams=False)]
            self._sights[sensor] = (number, *kept)
        return tuple(kept)

    def _seeing(
        self,
        points: Points,
        sensor: Sensor | str | None,
        keep_beams: bool,
        scale: float | None = None,
        name: str = IN_MEMORY,
    ) -> "tuple[Checkpoint, Sight]":
        """This model for the sensor of points, with `keep_beams` in the view that keeps all its
        beams, and how clouds of it are seen; messages give the points a name.
        """
        source = None if sensor is None else named_sensor(sensor)
        described = Described(name, SourceOptions(PLAIN, name))
        reading = reading_for([], self, labels=False)
        found = sight(described, {Path(name): points}, reading, source, scale, each=True)
        if keep_beams and found.whole:
            return self.through(found.whole)._seeing(points, sensor, False, scale, name)
        for lost in found.lines[1:]:
            warnings.warn(lost.removeprefix(f"{name}: "), stacklevel=4)
        return self._without_rows() if found.lines else self, found.see

    @property
    def keeps_beams(self) -> bool:
        """Whether scans whose beams look past its sensor are completed in their own view: a model
        by name, unless `through` chose its sensor.
        """
        return name_of(self.path) is not None and not self.chosen

    def completer(
        self,
        sensor: Sensor | str | None = None,
        *,
        reflectance_scale: float | None = None,
        columns: Sequence[str] | None = None,
        fill_gaps: bool = False,
        **how: Any,
    ) -> Completer:
        """Completes clouds of one sensor, one after another, with all their fields (`Completer`).

        The view is that of the command line: the clouds' own, if it sees more than the model's, or
        the one chosen by `through`.

        Args:
            sensor: Sensor of the clouds, by name or YAML file; None: found by the beams of the
                first one.
            reflectance_scale: Value of full reflectance; None: found for each cloud from its values
                alone (`r2flow.data.seeing.own_scale`).
            columns: Fields to rename, as `intensities=reflectance`; names of the columns of rows.
            fill_gaps: Treat rays without a return as unmeasured, as in a thinned scan.
            how: Options of `r2flow.model.completion.complete`: sampler, precision, ...
        """

        def decide(points: Points, name: str) -> "tuple[Checkpoint, Sight]":
            return self._seeing(points, sensor, self.keeps_beams, reflectance_scale, name)

        return Completer(decide, columns, fill_gaps, how)

    def _without_rows(self) -> "Checkpoint":
        """This model for another sensor, whose beams fill other rows."""
        if not isinstance(self.generator, TransferFlow):
            return self
        return self.through(self.sensor, numbered=False)

    def _coarser(self, scans: Described) -> bool:
        """Whether r2flow wrote some scans as images of this sensor in another size."""
        stored = scans.stored
        return stored is not None and self.sensor.resized(*stored.sensor.shape).same_image(
            stored.sensor
        )

    def through(self, sensor: Sensor | str, numbered: bool = True) -> "Checkpoint":
        """This transfer flow for images of another sensor, by name, YAML file or `Sensor`; the
        weights are shared.
        """
        if not isinstance(self.generator, TransferFlow):
            raise InputError(
                f"{self.path} is a model of one sensor: leave --to, --sensor and --size, or "
                "through, out."
            )
        return replace(
            self,
            generator=self.generator.at(
                self.generator.space.through(named_sensor(sensor)), numbered
            ),
            chosen=True,
        )

    def points(self, images: Tensor) -> list[np.ndarray]:
        """The returns of each range image, (N, 4): x, y, z in metres and reflectance; see
        `ModelSpace.points`.
        """
        return self.generator.space.points(images)

    def save(self, path: str | Path) -> None:
        """Write one file that `r2flow.load` reads; see `save_checkpoint`."""
        save_checkpoint(self, path)


@torch.inference_mode(False)  # `mmps` needs gradients later
def load_checkpoint(
    path: str | Path,
    device: str | torch.device = "cpu",
    averaged: bool = True,
    backbone: nn.Module | None = None,
) -> Checkpoint:
    """Load a generator from a checkpoint file (of r2flow or published), a run folder, or by a
    model's name.

    The averaged weights are the default for evaluation; `averaged=False` loads the raw weights of
    an r2flow run. `backbone`: a module like the one that the model was trained with; a copy takes
    the weights. Raises `InputError` without a usable checkpoint, or if the weights do not fit the
    config.
    """
    path = find_checkpoint(path)
    try:
        with naming(path), reading_errors(path):
            if path.suffix == ".safetensors":
                notes = read_safetensors(path)
                config = ModelConfig(notes["config"])
                weights = notes["weights"]
                checkpoint = _built(config, weights, notes, path, int(notes["step"]), backbone)
            else:
                checkpoint = _of_torch(read_checkpoint(path), path, averaged, backbone)
    except InputError:
        raise
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        raise InputError(
            f"{path} is not what r2flow writes, or damaged ({type(error).__name__}: {error})."
        ) from error
    generator = checkpoint.generator.to(device)
    beside = path.with_suffix(".calibration.yaml")
    if isinstance(generator, TransferFlow) and beside.is_file():
        generator.calibration = Calibration.read(beside)
    return replace(checkpoint, generator=generator)


def _of_torch(content: Any, path: Path, averaged: bool, backbone: nn.Module | None) -> Checkpoint:
    """The generator of a torch file, of Lightning or of a published system."""
    published = next((known for known in FORMATS.values() if known.holds(content)), None)
    if published is not None:
        converted = published.read(content, path, averaged)
        config = converted.config
        # elevations of its own need a name of its own, as in `build_sensor`
        if converted.elevations is not None:
            rings = torch.rad2deg(converted.elevations.double()).tolist()
            config["sensor"] |= {
                "name": "hdl64e_rings_published",
                "elevations": rings,
                "rays": "centre",
            }
        drawing = {"sampler": converted.sampler, "fixed": converted.fixed}
        return _built(
            ModelConfig(config), converted.weights, drawing, path, converted.step, kind="published"
        )
    if isinstance(content, dict) and {HYPER, NOTES, "state_dict"} <= content.keys():
        state: Any = (
            content["state_dict"]
            if averaged
            else content.get("current_model_state", content["state_dict"])
        )
        weights = {
            name.removeprefix(PREFIX): value
            for name, value in state.items()
            if name.startswith(PREFIX)
        }
        notes = content[NOTES]
        config = config_of(
            content[HYPER], content.get("datamodule_hyper_parameters") or {}, notes["stage"]
        )
        if backbone is None and config["backbone"]:  # may name the class of a network alone
            config["backbone"] = BACKBONES.options(config["backbone"])
        config |= {"plugins": notes["plugins"], "trainer": {"max_steps": notes["total_steps"]}}
        step = int(content.get("global_step", 0))
        return _built(ModelConfig(config), weights, notes, path, step, backbone)
    systems = ", ".join(known.system for known in FORMATS.values())
    found = (
        ", ".join(map(repr, list(content)[:6]))
        if isinstance(content, dict)
        else type(content).__name__
    )
    raise InputError(
        f"{path} is a torch file but is not a checkpoint of a generator: it has neither '{HYPER}' "
        f"and '{NOTES}' (of a "
        f"stage in a Lightning Trainer) nor a published layout ({systems}); found {found}."
    )


def _built(
    config: ModelConfig,
    weights: Mapping[str, Tensor],
    drawing: Mapping[str, Any],
    path: Path,
    step: int,
    backbone: nn.Module | None = None,
    kind: str = "r2flow",
) -> Checkpoint:
    """The generator of a config with its weights and default samplers."""
    # First weights are drawn and replaced: neither the caller's random numbers nor torch's defaults
    # matter.
    with (
        made_with(config.plugins, str(path)),
        torch.random.fork_rng(devices=[]),
        torch.device("cpu"),
        ExitStack() as stack,
    ):
        stack.callback(torch.set_default_dtype, torch.get_default_dtype())
        torch.set_default_dtype(torch.float32)
        network = {} if backbone is None else {"backbone": BACKBONES.options(deepcopy(backbone))}
        generator = build_generator({**config.model, **network})
        check_weights(generator, weights)
        generator.load_state_dict(weights)
        if drawing.get("sampler"):
            few = drawing.get("few")
            generator.run_by(
                build_sampler(drawing["sampler"]),
                few and build_sampler(few),
                bool(drawing.get("fixed")),
            )
    return Checkpoint(generator.eval().requires_grad_(False), config, step, path, kind)


def check_weights(model: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Check all names, shapes, types and values before loading."""
    expected = model.state_dict()
    missing = sorted(expected.keys() - weights.keys())
    surplus = sorted(weights.keys() - expected.keys())
    unlike = "its weights do not fit its config:"
    names = f"{len(missing)} names missing {missing[:2]}, {len(surplus)} unknown {surplus[:2]}"
    check(not (missing or surplus), f"{unlike} {names}.")
    for name, value in expected.items():
        weight = weights[name]
        fits = (
            weight.shape == value.shape and weight.is_floating_point() == value.is_floating_point()
        )
        found = f"'{name}' has shape {tuple(weight.shape)} ({weight.layout}, {weight.dtype})"
        check(
            fits and is_dense(weight),
            f"{unlike} {found}, the config (or a plug-in's class by its defaults) makes it "
            f"{tuple(value.shape)} ({value.dtype}).",
        )
    # buffers may be infinite, as the mask of an attention
    trained = (name for name, _ in model.named_parameters())
    # faster than all()
    broken = next((n for n in trained if not weights[n].sum(dtype=torch.float64).isfinite()), None)
    check(
        broken is None, f"'{broken}' has values that are NaN or infinite. Use another checkpoint."
    )
