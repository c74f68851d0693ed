"""Checkpoints: trained generators on disk, written atomically, checked on reading, without code
execution.
"""

import json
import os
import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from r2flow.config import check_tree, learned
from r2flow.data.opening import describe, reading_for
from r2flow.data.partial import PartialScan, open_partial
from r2flow.errors import IN_MEMORY, InputError, check, naming
from r2flow.files import reading_errors, write_file
from r2flow.generators import Generator, TransferFlow, build_generator
from r2flow.hashing import state_hash
from r2flow.lidar.encoding import Encoding, build_space
from r2flow.lidar.sensors import Sensor, named_sensor
from r2flow.model.completion import complete
from r2flow.model.published import BACKBONE, FORMATS, inert, plain
from r2flow.model.sampling import sample
from r2flow.models import MODELS, find_model
from r2flow.plugins import made_with
from r2flow.registry import did_you_mean
from r2flow.samplers import build_sampler

FOLDER = "checkpoints"
PREFIX = "generator."  # of the generator's weights in a LightningModule
COMPILED = "_orig_mod."  # in the names of the weights after torch.compile
HYPER = "hyper_parameters"  # Lightning's key of a module's options
# key of our notes in a checkpoint of Lightning, and of the JSON metadata in a .safetensors
NOTES = "r2flow"
MODEL = (
    "backbone",
    "sensor",
    "encoding",
    "generator",
)  # hyper-parameters of the model, the others are the stage's
SMALL = 256  # largest matrix, in elements, that `half` leaves in float32, as it does all vectors


@dataclass(frozen=True, repr=False)
class Checkpoint:
    """A trained generator. `Checkpoint(generator, config)` wraps a generator that was trained
    without a run.

    Attributes:
        generator: The generator with its averaged weights, in eval mode.
        config: The training config, as plain dicts; `build_generator(config)` builds the same
            architecture.
        step: Optimiser steps taken.
        path: File that it was read from.
        format: `r2flow`, or `published` for files of the original implementations.
    """

    generator: Generator
    config: dict[str, Any]
    step: int = 0
    path: Path = Path("unsaved")
    format: str = "r2flow"

    def __repr__(self) -> str:
        kind = (self.config.get("generator") or {}).get("name", "rectified_flow")
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
            how: Options of `r2flow.model.sampling.sample`: sampler, steps, batch_size, region, ...
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
            if not isinstance(
                images, Tensor
            ):  # a message's points: read-only or big-endian, which torch does not take
                images = torch.from_numpy(np.array(images, images.dtype.newbyteorder("=")))
        if isinstance(images, Tensor) and images.ndim == 2:
            with TemporaryDirectory(prefix=f"{IN_MEMORY} ") as folder:
                np.save(file := Path(folder, "points.npy"), images.detach().float().cpu())
                try:
                    return self.complete(file, state, num, seed, sensor=sensor, **how)
                except InputError as error:
                    raise InputError(str(error).replace(str(file), IN_MEMORY)) from None
        if isinstance(images, str | Path):
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
        self, specs: Sequence[str], sensor: Sensor | str | None = None, **how: Any
    ) -> "tuple[Checkpoint, list[PartialScan], list[str]]":
        """This model for the sensor of scans to complete, the scans, and remarks; see
        `r2flow.data.partial`.
        """
        reading = reading_for([], self, columns=how.pop("columns", None))
        scans, remarks = open_partial(
            specs, reading, None if sensor is None else named_sensor(sensor), **how
        )
        if (
            not remarks
            or not isinstance(self.generator, TransferFlow)
            or all(map(self._coarser, specs))
        ):
            return self, scans, remarks
        return (
            self.through(self.sensor, numbered=False),
            scans,
            remarks,
        )  # another sensor fills other rows

    def _coarser(self, spec: str) -> bool:
        """Whether r2flow wrote some scans as images of this sensor in another size."""
        stored = describe(spec).stored
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
        )

    def points(self, images: Tensor) -> list[np.ndarray]:
        """The returns of each range image, (N, 4): x, y, z in metres and reflectance; see
        `ModelSpace.points`.
        """
        return self.generator.space.points(images)

    def save(self, path: str | Path) -> None:
        """Write one file that `r2flow.load` reads; see `save_checkpoint`."""
        save_checkpoint(self, path)


def title_of(path: Path) -> str:
    """Name of a checkpoint's run, else of its file."""
    path = path.resolve()
    return path.parents[1].name if path.parent.name == FOLDER else path.stem


def step_of(path: Path) -> int:
    """The step in a checkpoint's file name; -1 without one."""
    match = re.search(r"step-(\d+)", path.name)
    return int(match.group(1)) if match else -1


def checkpoints_of(run: str | Path) -> list[Path]:
    """The checkpoints of a run folder, the latest first."""
    paths = [
        path
        for path in Path(run, FOLDER).glob("step-*.ckpt")
        if path.is_file() and not path.is_symlink()
    ]
    return sorted(paths, key=step_of, reverse=True)


def find_checkpoint(path: str | Path) -> Path:
    """Path of a checkpoint file, of the latest checkpoint of a run folder, or of a model's file by
    its name.

    A file or a run in the current folder takes precedence over a model of the same name.
    """
    name, path = str(path).rstrip("/"), Path(path).expanduser()
    if path.is_file():
        return path
    checkpoints = checkpoints_of(path) or sorted(
        path.glob("step-*.ckpt"), key=step_of, reverse=True
    )
    if checkpoints:
        return checkpoints[0]
    if name in MODELS and (path.is_dir() or not path.exists()):
        return find_model(name)
    problem = f"no checkpoint at {path}."
    known = [*MODELS, *(folder.name for folder in path.parent.glob("*/"))]
    models = ", ".join(MODELS)
    hint = f"Give a checkpoint file, a run folder or a model ({models})."
    hint += did_you_mean(path.name, known)
    if path.is_dir():
        problem = f"{path} holds no checkpoint ({FOLDER}/step-*.ckpt)."
        runs = sorted(
            str(folder.parent)
            for folder in path.glob(f"*/{FOLDER}")
            if checkpoints_of(folder.parent)
        )
        hint = f"It holds runs: give {' or '.join(runs[:8])}." if runs else hint
    elif path.exists():  # reading a pipe would block
        problem = f"{path} is not a regular file."
    raise InputError(f"{problem} {hint}")


def read_checkpoint(path: str | Path, map_location: Any = "cpu") -> Any:
    """Read an r2flow checkpoint, a dict, or a published one. Only tensors and plain values: a file
    cannot run code.
    """
    with reading_errors(Path(path)), open(path, "rb") as file:
        return read_torch(file, path, map_location)


def read_torch(file: IO[bytes], name: object, map_location: Any = "cpu") -> Any:
    """Read tensors and plain values from a torch file, without code execution; `InputError` for any
    other content.
    """
    _check_archive(file, name)
    try:
        with warnings.catch_warnings(action="ignore"), inert():  # torch may warn
            content = torch.load(file, map_location=map_location, weights_only=True)
            if not isinstance(content, dict):
                return content
            content = {key: plain(value) for key, value in content.items()}
            check_tree(content.get(HYPER) or {})
            return content
    except Exception as error:  # torch.load raises nearly any exception on other files
        if isinstance(error, OSError) and error.errno is not None:
            raise
        code = re.search(r"(?:GLOBAL|Unsupported (?:global|class):?(?: GLOBAL)?) (\S+)", str(error))
        size = file.seek(0, os.SEEK_END)
        problem = f"is not a checkpoint, or a damaged one ({size} bytes). "
        problem += "Give a .ckpt of r2flow or a published file."
        if code is not None and isinstance(error, pickle.UnpicklingError):
            problem = (
                f"is refused: it holds objects that would run code when loaded ({code[1]}), not "
                "only tensors and plain "
                "values. Ask its author for a weights-only file."
            )
        raise InputError(f"{name} {problem}") from None


def _check_archive(file: IO[bytes], name: object) -> None:
    """Refuse zip archives with compressed entries (zip bombs), which torch never writes, and those
    whose checksums (CRC-32) differ, which torch does not compare.
    """
    try:
        archive = zipfile.ZipFile(file)
    except Exception:  # torch's legacy format, or damaged: torch.load tells
        file.seek(0)
        return
    entries = archive.infolist()
    packed = any(entry.compress_type != zipfile.ZIP_STORED for entry in entries)
    if packed or sum(entry.file_size for entry in entries) > file.seek(0, os.SEEK_END):
        raise InputError(
            f"{name} holds compressed tensors, which torch never writes. Ask its author for "
            "another file."
        )
    try:
        broken = archive.testzip()
    except Exception:  # a damaged header of an entry
        broken = "an entry"
    if broken is not None:
        raise InputError(
            f"{name} is damaged: the checksum of {broken} differs. Copy or fetch it again."
        )
    file.seek(0)


@torch.inference_mode(False)  # `mmps` needs gradients later
def load_checkpoint(
    path: str | Path, device: str | torch.device = "cpu", averaged: bool = True
) -> Checkpoint:
    """Load a generator from a checkpoint file (of r2flow or published), a run folder, or by a
    model's name.

    The averaged weights are the default for evaluation; `averaged=False` loads the raw weights of
    an r2flow run. Raises `InputError` without a usable checkpoint, or if the weights do not fit the
    config.
    """
    path = find_checkpoint(path)
    try:
        with naming(path), reading_errors(path):
            if path.suffix == ".safetensors":
                notes = read_safetensors(path)
                checkpoint = _built(
                    notes["config"], notes["weights"], notes, path, int(notes["step"])
                )
            else:
                checkpoint = _of_torch(read_checkpoint(path), path, averaged)
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
    return replace(checkpoint, generator=checkpoint.generator.to(device))


def _of_torch(content: Any, path: Path, averaged: bool) -> Checkpoint:
    """The generator of a torch file, of Lightning or of a published system."""
    published = next((known for known in FORMATS.values() if known.holds(content)), None)
    if published is not None:
        converted = published.read(content, path, averaged)
        config = converted.config
        if (
            converted.elevations is not None
        ):  # elevations of its own need a name of its own, as in `build_sensor`
            rings = torch.rad2deg(converted.elevations.double()).tolist()
            config["sensor"] |= {
                "name": "hdl64e_rings_published",
                "elevations": rings,
                "rays": "centre",
            }
        drawing = {"sampler": converted.sampler, "fixed": converted.fixed}
        return _built(config, converted.weights, drawing, path, converted.step, "published")
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
        config |= {"plugins": notes["plugins"], "trainer": {"max_steps": notes["total_steps"]}}
        return _built(config, weights, notes, path, int(content.get("global_step", 0)))
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
    config: dict[str, Any],
    weights: Mapping[str, Tensor],
    drawing: Mapping[str, Any],
    path: Path,
    step: int,
    kind: str = "r2flow",
) -> Checkpoint:
    """The generator of a config with its weights and default samplers."""
    # First weights are drawn and replaced: neither the caller's random numbers nor torch's defaults
    # matter.
    with (
        made_with(config, str(path)),
        torch.random.fork_rng(devices=[]),
        torch.device("cpu"),
        ExitStack() as stack,
    ):
        stack.callback(torch.set_default_dtype, torch.get_default_dtype())
        torch.set_default_dtype(torch.float32)
        generator = build_generator(config)
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


def config_of(
    stage: Mapping[str, Any], data: Mapping[str, Any], name: str | None
) -> dict[str, Any]:
    """The config of a model by the hyper-parameters of its stage, of this name, and of its data.

    Its keys are the hyper-parameters of `MODEL`, `sampler`, `few` and `seed`, `stage` with the
    others, and `data`.
    """
    options = dict(stage)
    config: dict[str, Any] = {key: options.pop(key) for key in (*MODEL, "sampler", "few", "seed")}
    config["stage"] = {"name": name, **options}
    config["data"] = {
        key: value for key, value in data.items() if key not in ("sensor", "encoding", "seed")
    }
    return config


def weights_hash(checkpoint: Checkpoint) -> str:
    """Hash of a generator in 16 hex digits: averaged weights, sensor and encoding, independent of
    the file format.
    """
    meaning = {key: checkpoint.config[key] for key in ("sensor", "encoding")}
    state = {
        name.removeprefix(BACKBONE): value
        for name, value in checkpoint.generator.state_dict().items()
    }
    return state_hash(state, meaning)[:16]


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors and the metadata of a `.safetensors`."""
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118


def read_safetensors(path: Path) -> dict[str, Any]:
    """Read `weights`, config, step and samplers of an r2flow `.safetensors`."""
    weights, metadata = read_tensors(path)
    notes = json.loads(metadata.get(NOTES, "{}"))
    if not isinstance(notes, dict) or notes.pop("digest", None) != state_hash(weights, notes):
        raise InputError(
            f"{path} is not a model of r2flow, or damaged: its checksum differs. Use another "
            "checkpoint."
        )
    check_tree(notes["config"])
    return notes | {"weights": weights}


def save_checkpoint(checkpoint: Checkpoint, path: str | Path, half: bool = False) -> None:
    """Write a generator with its config as a `.safetensors`; `half` rounds large matrices to
    float16.

    The bytes depend on the generator alone: of its config, the file stores the keys of
    `r2flow.config.learned` and the names of plug-ins, without paths of this machine.
    """
    path = Path(path)
    check(path.suffix == ".safetensors", f"{path}: a checkpoint is written as .safetensors.")
    moved = checkpoint.sensor != build_space(checkpoint.config).sensor
    check(
        not moved,
        f"{path}: a file keeps the sensor of training alone: save the model before `through`.",
    )
    state, parameters = checkpoint.generator.state_dict(), checkpoint.generator.named_parameters()
    weights = {
        n.replace(COMPILED, ""): value.detach().cpu().contiguous().clone()
        for n, value in state.items()
    }
    if half:
        large = [
            n.replace(COMPILED, "")
            for n, value in parameters
            if value.ndim > 1 and value.numel() > SMALL
        ]
        weights |= {n: weights[n].half() for n in large}
        finite = all(weights[n].isfinite().all() for n in large)
        check(
            finite, f"{path}: weights beyond 65504 do not fit into float16: save them without half."
        )
    plugins = [Path(name).name for name in checkpoint.config.get("plugins") or ()]
    config = learned(checkpoint.config) | ({"plugins": plugins} if plugins else {})
    notes = {"config": config, "step": checkpoint.step, **checkpoint.generator.drawing()}
    # Under one key, since the order of several metadata keys is not fixed.
    write_file(
        path,
        save(
            weights, metadata={NOTES: json.dumps({**notes, "digest": state_hash(weights, notes)})}
        ),
    )


def is_dense(value: object) -> bool:
    """Whether a value is a dense real tensor."""
    if not isinstance(value, Tensor) or value.layout != torch.strided:
        return False
    return not (value.is_meta or value.is_quantized or value.is_complex())


def check_weights(model: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Check all names, shapes, types and values before loading."""
    expected = model.state_dict()
    missing, surplus = (
        sorted(expected.keys() - weights.keys()),
        sorted(weights.keys() - expected.keys()),
    )
    unlike = "its weights do not fit its config:"
    names = f"{len(missing)} names missing {missing[:2]}, {len(surplus)} unknown {surplus[:2]}"
    check(not (missing or surplus), f"{unlike} {names}.")
    for name, value in expected.items():
        given = weights[name]
        fits = given.shape == value.shape and given.is_floating_point() == value.is_floating_point()
        found = f"'{name}' has shape {tuple(given.shape)} ({given.layout}, {given.dtype})"
        check(
            fits and is_dense(given),
            f"{unlike} {found}, the config makes it {tuple(value.shape)} ({value.dtype}).",
        )
    trained = (
        name for name, _ in model.named_parameters()
    )  # buffers may be infinite, as the mask of an attention
    broken = next(
        (n for n in trained if not weights[n].sum(dtype=torch.float64).isfinite()), None
    )  # faster than all()
    check(
        broken is None, f"'{broken}' has values that are NaN or infinite. Use another checkpoint."
    )
