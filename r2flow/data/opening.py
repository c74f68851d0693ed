"""From a name to its scans: for runs, verbs and reports alike.

    scans = open_scans("kitti_360:/data/KITTI-360", Reading(SENSORS["hdl64e"]), split="test")
    scans.source[0]                 range in metres and reflectance, (2, H, W)

`SOURCES` is the table of what a name may be. To add a kind of scans, enter it there:
`SOURCES.add("mine", Layout(find_mine))` for scan files that `find_mine(root)` finds, or a `SourceKind` of your own.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from r2flow.data import layouts
from r2flow.data.layouts import Drive, Layout, SourceKind, spans_of
from r2flow.data.options import FOLDER, PREPARED, SIMULATED, SourceOptions
from r2flow.data.prepared import PreparedScans, read_prepared, refuse_other_images
from r2flow.data.reading import AUTO, Reading, lacks_reflectance
from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanFiles, ScanSource, SimulatedScans, made_here, warn_of_other_sensor
from r2flow.errors import InputError, tell_odd
from r2flow.lidar.scan_files import read_range_image
from r2flow.lidar.sensor_files import ENDINGS, read_sensor
from r2flow.lidar.sensors import SENSORS, Sensor, build_sensor
from r2flow.registry import Registry, did_you_mean
from r2flow.store import MANIFEST, read_manifest

log = logging.getLogger(__name__)

SCENES = 1000  # of simulated scans, where nobody says how many


class Simulated(SourceKind):
    """Scenes of the simulator."""

    levels = 100

    def open(self, options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
        scenes = range(first_scene, first_scene + options.scenes)
        return SimulatedScans(reading.sensor, seed, scenes, bool(reading.reflectance))


class Prepared(SourceKind):
    """Shards of `r2flow prepare`."""

    def open(self, options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
        return open_prepared(options.folder, reading, options.split, options.drives)

    def lacks_reflectance(self, options: SourceOptions, on_bad_scan: str = "error") -> str | None:
        return f"the scans in {options.folder} have no reflectance" if self.levels_of(options) is None else None

    def levels_of(self, options: SourceOptions) -> int | None:
        levels: int | None = read_prepared(Path(options.folder).expanduser())[0]["levels"]
        return levels


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
) -> ScanSet:
    """The scans that a name stands for, none of them read yet but for what decides whether they have reflectance.

    Args:
        spec: A scan file, a range image (.npy) or a folder of them, a folder of `r2flow prepare`, `NAME:ROOT` with a
            name of `SOURCES`, `simulated:SEED`, a folder of samples, or a run folder, which stands for its samples.
        reading: How scans become images; `reading_for` the scans if left out.
        split: A part of the data set's standard split.
        num: At most so many, by a fixed shuffle; the number of simulated scenes.
        own_size: For pictures: a range image's own size is taken in place of the sensor's, and no beams are compared.

    Raises:
        InputError: nothing is there, or what is there cannot become such images.
    """
    label = str(spec)
    options, file = parse(label)
    reading = reading or reading_for([label])
    if file is None:
        columns = None if reading.columns is None else list(reading.columns)
        options = replace(options, split=split, scenes=num or SCENES, reading={"columns": columns})
        if options.name == SIMULATED:
            seed, options = int(options.folder), replace(options, root=None)
            return ScanSet(label, open_source(options, reading, seed), reading.sensor)
        return ScanSet(label, open_source(options, reading), reading.sensor).limited(num)
    image = read_range_image(file)
    if image is not None:  # points can be seen through any sensor
        refuse_other_samples(file.parent, reading.sensor)
    elif not own_size:
        warn_of_other_sensor([file], reading, file)
    if own_size and image is not None:
        reading = replace(reading, sensor=reading.sensor.resized(*image.shape[1:]))
    if reading.reflectance == AUTO:
        reading = replace(reading, reflectance=lacks_reflectance([file], reading.on_bad_scan, reading.columns) is None)
    return ScanSet(label, ScanFiles([file], reading, file.parent, about={"kind": "file"}), reading.sensor)


def open_source(options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
    """The scans of some options: `SourceKind.open`, with its arguments and `reading.reflectance` decided."""
    kind = SOURCES[options.name]
    if options.name == FOLDER:
        refuse_other_samples(Path(options.folder), reading.sensor)
        if made_here(options.folder):  # which is believed
            reading = replace(reading, reflectance_scale=1.0)
    if reading.reflectance == AUTO:
        reading = replace(reading, reflectance=kind.lacks_reflectance(options, reading.on_bad_scan) is None)
    return kind.open(options, reading, seed, first_scene)


def parse(text: str) -> tuple[SourceOptions, Path | None]:
    """The options that a user's name stands for, and the file where it is one."""
    path = Path(text).expanduser()
    kind, colon, rest = text.partition(":")
    if colon and kind in SOURCES:
        if kind == SIMULATED and not rest.isdecimal():
            raise InputError(f"simulated scans are named by their seed, as simulated:0; found {text!r}.")
        return SourceOptions(kind, rest, scenes=SCENES), None
    if colon and not path.exists() and "/" not in kind and "\\" not in kind:
        raise InputError(f"no data set named {kind!r}; known: {', '.join(SOURCES)}.{did_you_mean(kind, [*SOURCES])}")
    if path.is_file():
        return SourceOptions(FOLDER, str(path.parent)), path
    if not path.exists():
        raise InputError(
            f"{path} does not exist. Give a scan file, a folder of scans, NAME:FOLDER, simulated:SEED or a run."
        )
    if _manifest(path).get("format") == "r2flow scans":
        return SourceOptions(PREPARED, str(path)), None
    return SourceOptions(FOLDER, str(samples_of(path) or path)), None


def find_drives(
    name: str, root: str | Path, split: str | None = None, drives: Sequence[str | int] | None = None
) -> list[Drive]:
    """The drives of a data set of scan files, in order: `Layout.find_drives`."""
    return SOURCES[name].find_drives(SourceOptions(name, str(root), split, None if drives is None else list(drives)))


# What scans say of themselves


def samples_of(run: Path) -> Path | None:
    """The folder `samples` of a run folder; None where it is no run folder."""
    if not (run / "config.yaml").is_file() and not (run / "checkpoints").is_dir():
        return None
    if not (run / "samples").is_dir():
        raise InputError(f"{run} is a run without samples; draw some: r2flow sample {run} --out {run / 'samples'}.")
    return run / "samples"


class Model(Protocol):
    """A trained generator, as far as its images are concerned."""

    @property
    def config(self) -> Mapping[str, Any]: ...

    @property
    def sensor(self) -> Sensor: ...


def reading_for(
    scans: Sequence[str | Path | None],
    model: Model | None = None,
    sensor: Sensor | str | None = None,
    size: tuple[int, int] | None = None,
    projection: str | None = None,
    convention: str | None = None,
    reflectance_scale: float | None = None,
    columns: Sequence[str] | None = None,
) -> Reading:
    """How scans become images: as asked for, else as the model's training scans, else as the scans say, else as usual.

    Args:
        scans: Names as for `open_scans`; None is passed over.
        model: The model that the scans are for; another sensor or size than the model's is refused.
        sensor, size, ...: What was asked for; None where nothing was.

    Raises:
        InputError: an unknown name, or another sensor or size than the model's or a folder's of samples.
    """
    named = [str(one) for one in scans if one is not None]
    own = next((reading for one in named if (reading := own_reading(one)) is not None), None)
    kind = SOURCES[parse(named[0])[0].name] if named else SourceKind()
    reading = _reading_of(model) if model else own or Reading(SENSORS[kind.sensor])
    chosen = named_sensor(sensor or reading.sensor, size)
    if model is not None and (chosen.shape != model.sensor.shape or chosen.elevations != model.sensor.elevations):
        there, asked = (f"{one.name} {one.shape[0]}x{one.shape[1]}" for one in (model.sensor, chosen))
        raise InputError(f"the flow's images are of {there}, not of {asked}; leave --sensor and --size out.")
    reading = replace(reading, sensor=reading.sensor if model else chosen)
    for spec in named:  # before anything is read
        options, _ = parse(spec)
        if options.name == FOLDER:
            refuse_other_samples(Path(options.folder), reading.sensor)
    if reflectance_scale is None and named:
        reflectance_scale = usual_scale(named[0], reading.sensor)
    asked_for = {
        "projection": projection, "convention": convention, "reflectance_scale": reflectance_scale,
        "columns": None if columns is None else tuple(columns),
    }  # fmt: skip
    return replace(reading, **{key: value for key, value in asked_for.items() if value is not None})  # type: ignore[arg-type]


def _reading_of(model: Model) -> Reading:
    """How a model's training scans became images; of a mixture, what all its parts say."""
    data = model.config.get("data", {})
    readings = [part.get("reading") for part in data.get("parts") or ()] or [data.get("reading")]
    fields = ("projection", "convention", "reflectance_scale")
    agreed = {key: values.pop() for key in fields if len(values := {(one or {}).get(key) for one in readings}) == 1}
    return Reading(model.sensor, **{key: value for key, value in agreed.items() if value is not None})


def named_sensor(sensor: Sensor | str, size: tuple[int, int] | None = None) -> Sensor:
    """A sensor, by its name or its YAML file too, at an image size of (rows, columns)."""
    if isinstance(sensor, Sensor):
        return sensor if size is None else sensor.resized(*size)
    build = read_sensor if sensor.lower().endswith(ENDINGS) else build_sensor
    return build(sensor, *(size or (None, None)))


def read(path: str | Path, sensor: Sensor | str | None = None) -> Tensor:
    """`r2flow.read`."""
    reading = replace(reading_for([path], sensor=sensor), on_bad_scan="error", within_limits=True)
    image = torch.from_numpy(open_scans(path, reading).source[0])
    tell_odd()
    return image if len(image) > 1 else torch.cat([image, torch.zeros_like(image)])


def own_reading(spec: str | Path) -> Reading | None:
    """How scans that r2flow wrote are read: prepared scans, samples and simulated scans; None for other scans."""
    options, _ = parse(str(spec))
    if options.name not in (PREPARED, FOLDER):
        return None
    described = _manifest(Path(options.folder).expanduser()).get("recipe", {}).get("reading")
    if described is None or options.name == FOLDER:
        return described and Reading.of(described)
    return replace(Reading.of(described), reflectance=AUTO, within_limits=False)


def usual_scale(spec: str | Path, sensor: Sensor) -> float:
    """The value in the files of a set of scans that usually means full reflectance: 1 in what r2flow wrote."""
    options = parse(str(spec))[0]
    if options.name == FOLDER:
        return 1.0 if made_here(options.folder) else sensor.reflectance_scale or 1.0
    return SOURCES[options.name].reflectance_scale


def _manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a folder that r2flow wrote, empty where there is none."""
    try:
        return read_manifest(folder)
    except (FileNotFoundError, NotADirectoryError):
        return {}


def drawn_recipe(folder: Path) -> dict[str, Any] | None:
    """The recipe of a folder of samples or of completed scans; None of another folder."""
    manifest = _manifest(folder)
    return manifest["recipe"] if manifest.get("format") in ("r2flow samples", "r2flow answers") else None


def refuse_other_samples(folder: Path, sensor: Sensor) -> None:
    """Refuse a folder whose note says that its images are of another sensor or size."""
    recipe = drawn_recipe(folder)
    if recipe is None:
        return
    own = Reading.of(recipe["reading"])
    if own.sensor.shape == sensor.shape and np.allclose(own.sensor.elevations, sensor.elevations):
        return
    there, here = (f"{one.name} {one.shape[0]}x{one.shape[1]}" for one in (own.sensor, sensor))
    raise InputError(
        f"{folder} holds images of {there} (its {MANIFEST} says so), not of {here}: give no other --sensor or --size, "
        "no scans of another one beside them, and for a model of another one point clouds (.ply, .bin)."
    )


def refuse_parts(spec: str | Path) -> None:
    """Refuse samples of a part of each image: beside whole scans they would be judged as scans that lack the rest."""
    options, _ = parse(str(spec))
    if options.name == FOLDER and (drawn_recipe(Path(options.folder)) or {}).get("region"):
        raise InputError(
            f"{spec} holds a part of each scan alone (its {MANIFEST} says so) and cannot be judged beside whole scans: "
            "sample without --sector and --rows."
        )


# Prepared scans


def open_prepared(
    root: str | Path, reading: Reading, split: str | None = None, drives: Sequence[str | int] | None = None
) -> PreparedScans:
    """The scans of a folder that `r2flow prepare` has written, by the split and the drives of their data set."""
    folder = Path(root).expanduser()
    recipe, held = read_prepared(folder)
    refuse_other_images(folder, recipe, reading)
    kind = SOURCES[recipe["layout"]] if recipe["layout"] in SOURCES else SourceKind()
    if split is None and drives is None:
        parts = sorted({part for drive in held if (part := kind.split_of(drive.name))})
        if len(parts) > 1:
            log.warning("%s holds %s drives, and data.split=null takes all of them", folder, " and ".join(parts))
    spans = dict(zip(map(id, held), spans_of(held), strict=True))
    numbers = [number for drive in kind.chosen(held, split, drives) for number in spans[id(drive)]]
    scans = PreparedScans(folder, numbers, bool(reading.reflectance))
    if not len(scans):
        raise InputError(f"{folder} holds no usable scan of split={split!r}, drives={drives}.")
    return scans
