"""Open scans by name, for runs, commands and reports.

    scans = open_scans("kitti_360:/data/KITTI-360", Reading(SENSORS["hdl64e"]), split="test")
    scans.source[0]                 range in metres and reflectance, (2, H, W)

`SOURCES` is the registry of names. To add a kind of scans, register it: `SOURCES.add("mine", Layout(find_mine))` for
scan files listed by `find_mine(root)`, or a subclass of `SourceKind`.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r2flow.data import layouts
from r2flow.data.layouts import Drive, Layout, SourceKind
from r2flow.data.options import FOLDER, PREPARED, SIMULATED, SourceOptions
from r2flow.data.prepared import PreparedScans, read_prepared, refuse_other_images
from r2flow.data.reading import AUTO, Reading, lacks_reflectance
from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanFiles, ScanSource, SimulatedScans, made_here, mismatch_of, warn_of_other_sensor
from r2flow.errors import InputError, check
from r2flow.lidar.scan_files import read_range_image
from r2flow.lidar.sensors import SENSORS, Sensor, named_sensor
from r2flow.models import MODELS
from r2flow.registry import Registry, did_you_mean
from r2flow.store import MANIFEST, manifest_of

log = logging.getLogger(__name__)

SCENES = 1000  # default number of simulated scans


class Simulated(SourceKind):
    levels = 100

    def open(self, options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
        scenes = range(first_scene, first_scene + options.scenes)
        return SimulatedScans(reading.sensor, seed, scenes, bool(reading.reflectance))


class Prepared(SourceKind):
    """Shards of `r2flow prepare`."""

    def open(self, options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
        folder, split, drives = options.folder, options.split, options.drives
        store = read_prepared(folder)
        refuse_other_images(store, reading)
        stored, layout = store.drives, store.described["layout"]
        kind = SOURCES[layout if layout in SOURCES else FOLDER]
        if split is None and drives is None:
            parts = sorted({part for drive in stored if (part := kind.split_of(drive.name))})
            if len(parts) > 1:
                log.warning("%s holds %s drives, and data.split=null takes all of them", folder, " and ".join(parts))
        place = {name: number for number, name in enumerate(store.names)}
        numbers = [place[name] for drive in kind.chosen(stored, split, drives) for name in drive.scans]
        return PreparedScans(store, numbers, bool(reading.reflectance))

    def lacks_reflectance(self, options: SourceOptions, on_bad_scan: str = "error") -> str | None:
        return f"the scans in {options.folder} have no reflectance" if self.levels_of(options) is None else None

    def levels_of(self, options: SourceOptions) -> int | None:
        return read_prepared(options.folder).described["levels"]


SOURCES: Registry[SourceKind] = Registry(
    "data set",
    simulated=Simulated(),
    prepared=Prepared(),
    kitti_360=Layout(layouts.kitti_360, layouts.KITTI_360_SPLIT, levels=256),
    kitti_raw=Layout(layouts.kitti_raw, levels=100),
    odometry=Layout(layouts.odometry, layouts.ODOMETRY_SPLIT, levels=100),
    object=Layout(layouts.kitti_object, layouts.OBJECT_SPLIT, levels=100),
    nuscenes=Layout(layouts.nuscenes, sensor="hdl32e", reflectance_scale=255.0, levels=255),
    folder=Layout(layouts.folder),
)


def open_scans(
    spec: str | Path,
    reading: Reading | None = None,
    split: str | None = None,
    num: int | None = None,
    own_size: bool = False,
    sensor: Sensor | str | None = None,
    size: tuple[int, int] | None = None,
) -> ScanSet:
    """Open the scans of a name. Scans are read on access, except those that decide whether the set has reflectance.

    Args:
        spec: A scan file, a range image (.npy) or a folder of them, a folder of `r2flow prepare`, `NAME:ROOT` with a
            name of `SOURCES`, `simulated:SEED`, a folder of samples, or a run folder (its samples).
        reading: How scans become images; None: `reading_for([spec], sensor=sensor, size=size)`.
        split: A part of the data set's standard split.
        num: Maximum number of scans, chosen by a fixed shuffle; the number of simulated scenes.
        own_size: For pictures: take the size of the range image instead of the sensor's, and do not compare beams.
    """
    label = str(spec)
    options, file = parse(label)
    whole = num is None or (hasattr(num, "__index__") and num >= 1)
    check(whole, f"num must be a whole number of at least 1, or None for all scans; found {num!r}.")
    check(reading is None or (sensor is None and size is None), "give a reading, or a sensor and a size, not both.")
    reading = reading or reading_for([label], sensor=sensor, size=size)
    check(not split or (file is None and options.name != SIMULATED), f"{label} has no split: leave {split!r} out.")
    if file is None:
        options = replace(options, split=split, scenes=num or SCENES, reading={"columns": reading.columns})
        seed = int(options.root or 0) if options.name == SIMULATED else 0
        return ScanSet(label, open_source(options, reading, seed), reading.sensor).limited(num)
    image = read_range_image(file)
    if image is not None:  # points can be projected for any sensor
        refuse_other_samples(file.parent, reading.sensor)
    elif not own_size:
        warn_of_other_sensor([file], reading, file)
    if manifest_of(file.parent):  # its reflectance is in [0, 1]
        reading = replace(reading, reflectance_scale=1.0)
    if own_size and image is not None:
        reading = replace(reading, sensor=reading.sensor.resized(*image.shape[1:]))
    if reading.reflectance == AUTO:
        reading = replace(reading, reflectance=lacks_reflectance([file], reading.on_bad_scan, reading.columns) is None)
    return ScanSet(label, ScanFiles([file], reading, file.parent, about={"kind": "file"}), reading.sensor)


def open_source(options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
    """Open the scans of some options by `SourceKind.open`, after resolving `reading.reflectance`."""
    kind = SOURCES[options.name]
    if options.name == FOLDER:
        refuse_other_samples(options.folder, reading.sensor)
        if made_here(options.folder):  # its reflectance is in [0, 1]
            reading = replace(reading, reflectance_scale=1.0)
    if reading.reflectance == AUTO:
        reading = replace(reading, reflectance=kind.lacks_reflectance(options, reading.on_bad_scan) is None)
    source = kind.open(options, reading, seed, first_scene)
    chosen = f"split={options.split!r}, drives={options.drives}"
    check(len(source), f"{options.root or options.name} holds no usable scan of {chosen}.")
    return source


def parse(text: str) -> tuple[SourceOptions, Path | None]:
    """The options of a name of scans, and the file if the name is a file."""
    path = Path(text).expanduser()
    kind, colon, rest = text.partition(":")
    if colon and kind in SOURCES:
        if kind == SIMULATED and not rest.isdecimal():
            raise InputError(f"simulated scans are named by their seed, as simulated:0; found {text!r}.")
        return SourceOptions(kind, rest, scenes=SCENES), None
    if colon and not path.exists() and "/" not in kind and "\\" not in kind:
        SOURCES[kind]  # not known
    if path.is_file():
        return SourceOptions(FOLDER, str(path.parent)), path
    if not path.exists():
        check(text not in MODELS, f"{text} is a model; sample it first: r2flow sample {text} --out scans.")
        if path.is_symlink():
            raise InputError(f"{path} is a broken link to {path.readlink()}.")
        hint = did_you_mean(path.name, [*MODELS, *(other.name for other in path.parent.glob("*"))])
        raise InputError(f"{path} does not exist. Give a scan, a folder, NAME:FOLDER, simulated:SEED or a run.{hint}")
    if manifest_of(path).get("format") == "r2flow scans":
        return SourceOptions(PREPARED, str(path)), None
    if (path / "config.yaml").is_file() or (path / "checkpoints").is_dir():
        run, path = path, path / "samples"
        check(path.is_dir(), f"{run} is a run without samples; draw some: r2flow sample {run} --out {path}.")
    return SourceOptions(FOLDER, str(path)), None


def find_drives(
    name: str, root: str | Path, split: str | None = None, drives: Sequence[str | int] | None = None
) -> list[Drive]:
    """The drives of a data set of scan files, in order: `Layout.find_drives`."""
    return SOURCES[name].find_drives(SourceOptions(name, str(root), split, None if drives is None else list(drives)))


def reading_for(
    scans: Sequence[str | Path | None],
    model: Any = None,
    sensor: Sensor | str | None = None,
    size: tuple[int, int] | None = None,
    estimate_scale: bool = False,
    **fields: Any,
) -> Reading:
    """How scans become images: `fields` first, then the model's training scans, the scans' manifest, the defaults.

    `fields` are those of `Reading`; None is not given. The default sensor is hdl64e, or the built-in sensor whose beams
    plain scan files have. Scans have names as for `open_scans`; None is skipped. `model` is the checkpoint that they
    are for: another sensor or size than its own is refused. `estimate_scale` leaves None for plain scan files whose
    sensor does not tell it: an estimate.
    """
    specs = [str(spec) for spec in scans if spec is not None]
    stored = next((reading for spec in specs if (reading := own_reading(spec)) is not None), None)
    options = parse(specs[0])[0] if specs else SourceOptions(FOLDER)
    reading = _reading_of(model) if model else stored or Reading(SENSORS[SOURCES[options.name].sensor])
    given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items() if v is not None}
    reading = replace(reading, **given)
    if specs and not (model or stored or sensor):
        sensor = _detected(specs[0], reading)
    chosen = named_sensor(sensor or reading.sensor, size)
    if model is not None and not chosen.same_image(model.sensor):
        expected, asked = (f"{s.name} {s.shape[0]}x{s.shape[1]}" for s in (model.sensor, chosen))
        raise InputError(f"the flow's images are of {expected}, not of {asked}; leave --sensor and --size out.")
    reading = replace(reading, sensor=reading.sensor if model else chosen)
    if "reflectance_scale" in given or not specs:
        return reading
    trained = reading.reflectance_scale  # 1: also of scans that were scaled before the training
    scale = trained if model and trained != 1 else reading.sensor.reflectance_scale
    if not estimate_scale or stored or options.name != FOLDER:
        scale = scale_of(options, scale)
    return replace(reading, reflectance_scale=scale)


def _detected(spec: str, reading: Reading) -> str | None:
    """The built-in sensor of plain scan files whose beams are not those of `reading.sensor`."""
    options, file = parse(spec)
    if options.name != FOLDER:
        return None
    paths = [file] if file else [path for drive in SOURCES[FOLDER].find_drives(options) for path in drive.scans]
    mismatch = mismatch_of(paths, reading, options.folder)
    if mismatch is None or not mismatch.sure:
        return None
    log.warning("%s: read as scans of %s, whose beams are nearest; --sensor names another", spec, mismatch.name)
    return mismatch.name


def _reading_of(model: Any) -> Reading:
    """How a model's training scans became images; for a mixture, the fields on which all parts agree."""
    data = model.config.get("data", {})
    readings = [part.get("reading") for part in data.get("parts") or ()] or [data.get("reading")]
    fields = ("projection", "convention", "reflectance_scale")
    agreed = {key: values.pop() for key in fields if len(values := {(r or {}).get(key) for r in readings}) == 1}
    return Reading(model.sensor, **{key: value for key, value in agreed.items() if value is not None})


def read(path: str | Path, sensor: Sensor | str | None = None, reflectance_scale: float | None = None) -> Tensor:
    check(isinstance(path, str | Path), f"give the path of a scan; found {type(path)}.")
    right = reflectance_scale is None or (isinstance(reflectance_scale, Real) and 0 < reflectance_scale < math.inf)
    check(right, f"reflectance_scale must be a positive number, found {reflectance_scale!r}.")
    options, file = parse(str(path))
    check(options.name != FOLDER or file, f"{path} is a folder: r2flow.data.opening.open_scans opens it.")
    reading = reading_for([path], sensor=sensor, reflectance_scale=reflectance_scale, estimate_scale=True)
    image = torch.from_numpy(open_scans(path, replace(reading, on_bad_scan="error", within_limits=True)).source[0])
    return image if len(image) > 1 else torch.cat([image, torch.zeros_like(image)])


def own_reading(spec: str | Path) -> Reading | None:
    """The stored reading of scans that r2flow wrote (prepared, sampled or simulated); None for other scans."""
    options, _ = parse(str(spec))
    if options.name not in (PREPARED, FOLDER):
        return None
    stored = Reading.stored(options.folder)
    return replace(stored, reflectance=AUTO, within_limits=False) if stored and options.name == PREPARED else stored


def scale_of(options: SourceOptions, of_sensor: float | None) -> float:
    """Default value of full reflectance in the files of a set of scans; `of_sensor`: that of the sensor, if known."""
    if options.name == FOLDER:
        return 1.0 if made_here(options.folder) else of_sensor or 1.0
    return SOURCES[options.name].reflectance_scale


def refuse_other_samples(folder: Path, sensor: Sensor) -> None:
    """Refuse a folder of samples or completed scans of another sensor or size."""
    stored, reading = sensor, Reading.stored(folder)
    if reading and manifest_of(folder)["format"] in ("r2flow samples", "r2flow answers"):
        stored = reading.sensor
    theirs, ours = (f"{s.name} {s.shape[0]}x{s.shape[1]}" for s in (stored, sensor))
    check(
        stored.same_image(sensor),
        f"{folder} holds images of {theirs} (in its {MANIFEST}), not of {ours}: give no other --sensor or --size, "
        "no scans of another sensor next to them, and for a model of another sensor point clouds (.ply, .bin).",
    )


def refuse_parts(spec: str | Path) -> None:
    """Refuse samples of a region of the image: metrics would treat the rest of the image as missing returns."""
    options, _ = parse(str(spec))
    if options.name == FOLDER and manifest_of(options.folder).get("recipe", {}).get("region"):
        raise InputError(
            f"{spec} holds a part of each scan alone (see its {MANIFEST}) and cannot be compared with whole scans: "
            "sample without --sector and --rows."
        )
