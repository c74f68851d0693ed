"""Open scans by name, for runs, commands and reports.

    scans = open_scans("kitti_360:/data/KITTI-360", Reading(SENSORS["hdl64e"]), split="test")
    scans.source[0]                 range in metres and reflectance, (2, H, W)

`SOURCES` is the registry of names. To add a kind of scans, register a `Layout(find_mine)` for scan
files that `find_mine(root)` lists, or a subclass of `SourceKind`.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r2flow.base.errors import InputError, check
from r2flow.base.registry import Registry, did_you_mean
from r2flow.data import layouts
from r2flow.data.layouts import Drive, Layout, SourceKind
from r2flow.data.options import FOLDER, PREPARED, SIMULATED, ReadingOptions, SourceOptions
from r2flow.data.prepared import PreparedScans, read_prepared, refuse_other_images
from r2flow.data.reading import AUTO, Reading, lacks_reflectance
from r2flow.data.sets import ScanSet
from r2flow.data.sources import (
    LOOKED_AT,
    ScanFiles,
    ScanSource,
    SimulatedScans,
    made_here,
    mismatch_of,
    readable,
    spread,
    warn_of_other_sensor,
)
from r2flow.lidar.estimation import estimate_sensor
from r2flow.lidar.matching import in_words
from r2flow.lidar.scan_files import read_range_image
from r2flow.lidar.sensors import SENSORS, Sensor, named_sensor
from r2flow.model.shipped import MODELS
from r2flow.store import MANIFEST, manifest_of

log = logging.getLogger(__name__)

SCENES = 1000  # default number of simulated scans


class Simulated(SourceKind):
    levels = 100

    def open(
        self, scans: "Described", reading: Reading, seed: int = 0, first_scene: int = 0
    ) -> ScanSource:
        scenes = range(first_scene, first_scene + scans.options.scenes)
        return SimulatedScans(
            reading.sensor, seed, scenes, bool(reading.reflectance), reading.labels
        )


class Prepared(SourceKind):
    """Shards of `r2flow prepare`."""

    def open(
        self, scans: "Described", reading: Reading, seed: int = 0, first_scene: int = 0
    ) -> ScanSource:
        options = scans.options
        store = read_prepared(options.folder)
        refuse_other_images(store, reading)
        layout = store.described["layout"]
        kind = SOURCES[layout if layout in SOURCES else FOLDER]
        if options.split is None and options.drives is None:
            parts = {kind.split_of(drive.name) for drive in store.drives} - {None}
            if len(parts) > 1:
                log.warning(
                    "%s holds %s drives, and data.split=null takes all of them",
                    options.folder,
                    " and ".join(sorted(map(str, parts))),
                )
        place = {name: number for number, name in enumerate(store.names)}
        chosen = kind.chosen(store.drives, options.split, options.drives)
        numbers = [place[name] for drive in chosen for name in drive.scans]
        return PreparedScans(store, numbers, bool(reading.reflectance), reading.labels)

    def lacks_reflectance(self, scans: "Described", on_bad_scan: str = "error") -> str | None:
        if self.levels_of(scans) is None:
            return f"the scans in {scans.options.folder} have no reflectance"
        return None

    def levels_of(self, scans: "Described") -> int | None:
        return read_prepared(scans.options.folder).described["levels"]


SOURCES: Registry[SourceKind] = Registry(
    "data set",
    simulated=Simulated(),
    prepared=Prepared(),
    kitti_360=Layout(layouts.kitti_360, layouts.KITTI_360_SPLIT, levels=256),
    kitti_raw=Layout(layouts.kitti_raw, levels=100),
    odometry=Layout(layouts.odometry, layouts.ODOMETRY_SPLIT, levels=100),
    object=Layout(layouts.kitti_object, layouts.OBJECT_SPLIT, levels=100),
    nuscenes=Layout(layouts.nuscenes, sensor="hdl32e", reflectance_scale=255.0, levels=255),
    pandaset=Layout(
        layouts.pandaset,
        layouts.PANDASET_SPLIT,
        sensor="pandar64",
        reflectance_scale=255.0,
        levels=255,
    ),
    folder=Layout(layouts.folder),
)


@dataclass(frozen=True)
class Described:
    """A set of scans by its name: what it is and where it lies, each looked up once."""

    label: str  # the name, as given
    options: SourceOptions
    file: Path | None = None  # if the name is a file

    @property
    def kind(self) -> SourceKind:
        return SOURCES[self.options.name]

    @cached_property
    def drives(self) -> list[Drive]:
        """The drives of scan files, in order."""
        return self.kind.find_drives(self.options)

    @cached_property
    def paths(self) -> list[str | Path]:
        """The scan files, in order."""
        return [self.file] if self.file else [path for drive in self.drives for path in drive.scans]

    @cached_property
    def manifest(self) -> Mapping[str, Any]:
        """The manifest that r2flow wrote into the folder of the scans; empty if there is none."""
        return manifest_of(self.options.folder) if self.options.name in (PREPARED, FOLDER) else {}

    @cached_property
    def stored(self) -> Reading | None:
        """The stored reading of scans that r2flow wrote (prepared, sampled or simulated); None for
        other scans.
        """
        described = self.manifest.get("recipe", {}).get("reading")
        if described is None:
            return None
        stored = Reading.of(described)
        if self.options.name == PREPARED:
            stored = replace(stored, reflectance=AUTO, labels=False, within_limits=False)
        return stored

    @cached_property
    def made_here(self) -> bool:
        """Whether r2flow wrote the samples or simulated scans, whose reflectance is in [0, 1]."""
        return self.options.name == FOLDER and (
            bool(self.manifest) or made_here(self.options.folder)
        )

    @property
    def written_scale(self) -> float | None:
        """Full reflectance in files that r2flow wrote: 1, or of completed scans that of the scans;
        None if these differ.
        """
        scales = set(self.manifest.get("reflectance_scales", {"": 1.0}).values())
        return float(scales.pop()) if len(scales) == 1 else None

    @property
    def is_samples(self) -> bool:
        """Whether they are samples or completed scans of a model, which are images of one size."""
        return self.manifest.get("format") in ("r2flow samples", "r2flow answers")

    def scale(self, of_sensor: float | None) -> float | None:
        """Default value of full reflectance in the files; `of_sensor`: that of the sensor, if
        known. None: that of each file is estimated.
        """
        if self.options.name == FOLDER:
            return self.written_scale if self.made_here else of_sensor or 1.0
        return self.kind.reflectance_scale

    def part(self, **options: Any) -> "Described":
        """These scans with other options, such as a split."""
        part = Described(self.label, replace(self.options, **options), self.file)
        if (part.options.name, part.options.root) == (
            self.options.name,
            self.options.root,
        ):  # looked up once
            known = ("manifest", "stored", "made_here")
            vars(part).update({key: vars(self)[key] for key in known if key in vars(self)})
        return part

    def open(self, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
        """Open the scans by `SourceKind.open`, after resolving `reading.reflectance`."""
        options = self.options
        if options.name == FOLDER:
            self.refuse_other_samples(reading.sensor)
            if self.made_here:
                reading = replace(reading, reflectance_scale=self.written_scale)
        if reading.reflectance == AUTO:
            reading = replace(
                reading, reflectance=self.kind.lacks_reflectance(self, reading.on_bad_scan) is None
            )
        source = self.kind.open(self, reading, seed, first_scene)
        if not len(source):
            chosen = f"split={options.split!r}, drives={options.drives}"
            raise InputError(f"{options.root or options.name} holds no usable scan of {chosen}.")
        return source

    def refuse_other_samples(self, sensor: Sensor) -> None:
        """Refuse samples or completed scans of another sensor or size."""
        if not self.is_samples or self.stored is None or self.stored.sensor.same_image(sensor):
            return
        raise InputError(
            f"{self.options.folder} holds images of {self.stored.sensor} (in its {MANIFEST}), not "
            f"of {sensor}: give no other --sensor or --size, no scans of another sensor next to "
            "them, and for a model of another sensor point clouds (.ply, .bin)."
        )

    def refuse_parts(self) -> None:
        """Refuse samples of a region of the image: metrics would treat the rest of the image as
        missing returns.
        """
        if self.manifest.get("recipe", {}).get("region"):
            raise InputError(
                f"{self.label} holds a part of each scan alone (see its {MANIFEST}) and cannot be "
                "compared with whole scans: sample without --sector and --rows."
            )


Spec = str | Path | Described


def describe(spec: Spec) -> Described:
    """Look a name of scans up.

    Args:
        spec: A scan file, a range image (.npy) or a folder of them, a folder of `r2flow prepare`,
            `NAME:ROOT` with a name of `SOURCES`, `simulated:SEED`, a folder of samples, or a run
            folder (its samples).

    Raises:
        InputError: there is no such file, folder or data set.
    """
    if isinstance(spec, Described):
        return spec
    text = str(spec)
    path = Path(text).expanduser()
    kind, colon, rest = text.partition(":")
    if colon and kind in SOURCES:
        if kind == SIMULATED and not rest.isdecimal():
            raise InputError(
                f"simulated scans are named by their seed, as simulated:0; found {text!r}."
            )
        return Described(text, SourceOptions(kind, rest, scenes=SCENES))
    if colon and not path.exists() and "/" not in kind and "\\" not in kind:
        SOURCES[kind]  # not known
    if path.is_file():
        return Described(text, SourceOptions(FOLDER, str(path.parent)), path)
    if not path.exists():
        raise _not_found(text, path)
    folder = Described(text, SourceOptions(FOLDER, str(path)))
    if folder.manifest.get("format") == "r2flow scans":
        return Described(text, SourceOptions(PREPARED, str(path)))
    if (path / "config.yaml").is_file() or (path / "checkpoints").is_dir():
        samples = path / "samples"
        if not samples.is_dir():
            raise InputError(
                f"{path} is a run without samples; draw some: r2flow sample {path} --out {samples}."
            )
        return Described(text, SourceOptions(FOLDER, str(samples)))
    return folder


def _not_found(text: str, path: Path) -> InputError:
    if text in MODELS:
        return InputError(f"{text} is a model; sample it first: r2flow sample {text} --out scans.")
    if path.is_symlink():
        return InputError(f"{path} is a broken link to {path.readlink()}.")
    hint = did_you_mean(path.name, [*MODELS, *(other.name for other in path.parent.glob("*"))])
    return InputError(
        f"{path} does not exist. Give a scan, a folder, NAME:FOLDER, simulated:SEED or a run.{hint}"
    )


def open_scans(
    spec: Spec,
    reading: Reading | None = None,
    split: str | None = None,
    num: int | None = None,
    own_size: bool = False,
) -> ScanSet:
    """Open the scans of a name. Scans are read on access, except those that decide whether the set
    has reflectance.

    Args:
        spec: As for `describe`.
        reading: How scans become images; None: `reading_for([spec])`.
        split: A part of the data set's standard split.
        num: Maximum number of scans, chosen by a fixed shuffle; the number of simulated scenes.
        own_size: For pictures: take the size of the range image instead of the sensor's, and do not
            compare beams.
    """
    scans = describe(spec)
    if num is not None and num < 1:
        raise InputError(f"num must be at least 1, or None for all scans; found {num!r}.")
    reading = reading or reading_for([scans])
    simulated = scans.options.name == SIMULATED
    if split and (scans.file or simulated):
        raise InputError(f"{scans.label} has no split: leave {split!r} out.")
    if scans.file is None:
        if split or simulated or reading.columns:  # else what is listed stays so
            columns = ReadingOptions(columns=reading.columns)
            scans = scans.part(split=split, scenes=num or SCENES, reading=columns)
        seed = int(scans.options.root or 0) if simulated else 0
        return ScanSet(scans.label, scans.open(reading, seed), reading.sensor).limited(num)
    image = read_range_image(scans.file)
    if image is not None:  # points can be projected for any sensor
        scans.refuse_other_samples(reading.sensor)
    elif not own_size:
        warn_of_other_sensor([scans.file], reading, scans.file, scans.made_here)
    if scans.manifest:
        reading = replace(reading, reflectance_scale=scans.written_scale)
    if own_size and image is not None:
        reading = replace(reading, sensor=reading.sensor.resized(*image.shape[1:]))
    if reading.reflectance == AUTO:
        lacking = lacks_reflectance([scans.file], reading.on_bad_scan, reading.columns)
        reading = replace(reading, reflectance=lacking is None)
    source = ScanFiles([scans.file], reading, scans.file.parent, described={"kind": "file"})
    return ScanSet(scans.label, source, reading.sensor)


def find_drives(
    name: str, root: str | Path, split: str | None = None, drives: Sequence[str | int] | None = None
) -> list[Drive]:
    """The drives of a data set of scan files, in order: `Layout.find_drives`."""
    return SOURCES[name].find_drives(
        SourceOptions(name, str(root), split, None if drives is None else list(drives))
    )


def reading_for(
    scans: Sequence[Spec | None],
    model: Any = None,
    sensor: Sensor | str | None = None,
    size: tuple[int, int] | None = None,
    estimate_scale: bool = False,
    estimate_beams: bool = False,
    **fields: Any,
) -> Reading:
    """How scans become images: `fields` first, then the model's training scans, the scans'
    manifest, the defaults.

    `fields` are those of `Reading`; None is not given. The default sensor is hdl64e, or the
    built-in sensor whose beams plain scan files have. Scans have names as for `describe`; None is
    skipped. `model` is the checkpoint that they
    are for: another sensor or size than its own is refused. `estimate_scale` leaves None for plain
    scan files whose sensor does not tell it: an estimate. `estimate_beams` estimates the sensor of
    plain scan files that no built-in sensor fits.
    """
    described = [describe(spec) for spec in scans if spec is not None]
    stored = next((one.stored for one in described if one.stored is not None), None)
    first = described[0] if described else Described("", SourceOptions(FOLDER))
    reading = _reading_of(model) if model else stored or Reading(SENSORS[first.kind.sensor])
    given: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in fields.items() if v is not None
    }
    reading = replace(reading, **given)
    if described and not (model or stored or sensor):
        sensor = _detected(first, reading, estimate_beams)
    chosen = named_sensor(sensor or reading.sensor, size)
    if model is not None and not chosen.same_image(model.sensor):
        raise InputError(
            f"the flow's images are of {model.sensor}, not of {chosen}; leave --sensor and --size "
            "out."
        )
    reading = replace(reading, sensor=reading.sensor if model else chosen)
    if "reflectance_scale" in given:
        scale = given["reflectance_scale"]
        check(0 < scale < math.inf, f"reflectance_scale must be above 0, found {scale!r}.")
    if "reflectance_scale" in given or not described:
        return reading
    trained = reading.reflectance_scale  # 1: also of scans that were scaled before the training
    scale = trained if model and trained != 1 else reading.sensor.reflectance_scale
    if not estimate_scale or stored or first.options.name != FOLDER:
        scale = first.scale(scale)
    return replace(reading, reflectance_scale=scale)


def _detected(scans: Described, reading: Reading, estimate: bool) -> Sensor | str | None:
    """The sensor of plain scan files whose beams are not those of `reading.sensor`: the nearest
    built-in one, or with `estimate` their own if that does not fit.
    """
    if scans.options.name != FOLDER:
        return None
    mismatch = mismatch_of(scans.paths, reading, scans.made_here)
    if mismatch is None:
        return None
    name = mismatch.name if mismatch.sure else None
    if estimate and not (name and _fits(name, scans, reading)):
        with suppress(InputError):
            return _estimated(scans, reading)
    if name:
        log.warning(
            "%s: read as scans of %s, whose beams are nearest; --sensor names another",
            scans.label,
            name,
        )
    return name


def _fits(name: str, scans: Described, reading: Reading) -> bool:
    own = replace(reading, sensor=SENSORS[name])
    return mismatch_of(scans.paths, own, scans.made_here) is None


def _estimated(scans: Described, reading: Reading) -> Sensor:
    paths = [scans.paths[number] for number in spread(len(scans.paths), LOOKED_AT)]
    sensor = estimate_sensor([*readable(paths, reading.columns)], "estimated").sensor
    log.warning(
        "%s: no built-in sensor fits; read by its own %s; --sensor names another",
        scans.label,
        in_words(sensor.elevations),
    )
    return sensor


def _reading_of(model: Any) -> Reading:
    """How a model's training scans became images; for a mixture, the fields on which all parts
    agree.
    """
    data = model.config.get("data", {})
    first, *others = [part.get("reading") or {} for part in data.get("parts") or [data]]
    agreed = {
        key: first[key]
        for key in ("projection", "convention", "reflectance_scale")
        if first.get(key) is not None and all(other.get(key) == first[key] for other in others)
    }
    return Reading(model.sensor, **agreed)


def read(
    path: str | Path,
    sensor: Sensor | str | None = None,
    reflectance_scale: float | None = None,
    columns: Sequence[str] | None = None,
) -> tuple[Tensor, Sensor]:
    """The image of `r2flow.read` and its sensor."""
    scans = describe(path)
    if scans.file is None:
        raise InputError(f"{path} is a folder: r2flow.data.opening.open_scans opens it.")
    fields: dict[str, Any] = {"reflectance_scale": reflectance_scale, "columns": columns}
    reading = reading_for([scans], sensor=sensor, estimate_scale=True, **fields)
    reading = replace(reading, on_bad_scan="error", within_limits=True)
    own_size = sensor is None and read_range_image(scans.file) is not None
    opened = open_scans(scans, reading, own_size=own_size)
    image = torch.from_numpy(opened.source[0])
    if len(image) == 1:
        image = torch.cat([image, torch.zeros_like(image)])
    return image, opened.sensor
