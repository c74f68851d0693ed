"""From a name to its scans: for runs, verbs and reports alike.

    scans = open_scans("kitti_360:/data/KITTI-360", Reading(SENSORS["hdl64e"]), split="test")
    scans.source[0]                 range in metres and reflectance, (2, H, W)

`SOURCES` is the table of what a name may be. To add a kind of scans, enter it there:
`SOURCES.add("mine", Layout(find_mine))` for scan files that `find_mine(root)` finds, or a `SourceKind` of your own.
"""

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from r2flow.data import layouts
from r2flow.data.layouts import Drive, Layout, SourceKind, named_drive
from r2flow.data.manifest import Manifest, read_manifest
from r2flow.data.options import (
    FOLDER,
    MIXED,
    PAIRS,
    PREPARED,
    SIMULATED,
    DataOptions,
    PartOptions,
    SourceOptions,
)
from r2flow.data.prepared import PreparedScans, find_prepared
from r2flow.data.sets import ScanSet
from r2flow.data.sources import AUTO, Reading, ScanFiles, ScanSource, SimulatedScans, lacks_reflectance, range_image
from r2flow.data.store import MANIFEST
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.registry import Registry, check_options, did_you_mean

log = logging.getLogger(__name__)

SAMPLES = "scans.json"  # what a folder of samples says of itself
SCENES = 1000  # of simulated scans, where nobody says how many


class Simulated(SourceKind):
    """Scenes of the simulator."""

    def open(self, options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
        scenes = range(first_scene, first_scene + options.scenes)
        return SimulatedScans(reading.sensor, seed, scenes, bool(reading.reflectance))


class Prepared(SourceKind):
    """Shards of `r2flow prepare`."""

    def open(self, options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
        return open_prepared(
            options.folder, reading.sensor, options.split, options.drives, bool(reading.reflectance),
            reading.projection, reading.convention,
        )  # fmt: skip

    def lacks_reflectance(self, options: SourceOptions, on_bad_scan: str = "error") -> str | None:
        lacks = read_manifest(Path(options.folder).expanduser()).recipe.levels is None
        return f"the scans in {options.folder} have no reflectance" if lacks else None


SOURCES: Registry[SourceKind] = Registry(
    "data set",
    simulated=Simulated(),
    prepared=Prepared(),
    kitti_360=Layout(layouts.kitti_360, layouts.KITTI_360_SPLIT),
    kitti_raw=Layout(layouts.kitti_raw),
    odometry=Layout(layouts.odometry, layouts.ODOMETRY_SPLIT),
    object=Layout(layouts.kitti_object, layouts.OBJECT_SPLIT),
    nuscenes=Layout(layouts.nuscenes, sensor="hdl32e", reflectance_scale=255.0),
    folder=Layout(layouts.folder),
)


def open_scans(
    spec: str | Path | SourceOptions,
    reading: Reading | None = None,
    split: str | None = None,
    num: int | None = None,
    seed: int = 0,
    first_scene: int = 0,
    own_size: bool = False,
) -> ScanSet:
    """The scans that a name stands for, none of them read yet but for what decides whether they have reflectance.

    Args:
        spec: A scan file, a range image (.npy) or a folder of them, a folder of `r2flow prepare`, `NAME:ROOT` with a
            name of `SOURCES`, `simulated:SEED`, a folder of samples, a run folder, which stands for its samples; or the
            options of a run's data set.
        reading: How scans become images; what the scans say of themselves, or `usual_reading`, if left out.
        split: A part of the data set's standard split.
        num: At most so many, by a fixed shuffle; the number of simulated scenes.
        seed, first_scene: Of the options of simulated scans, the seed and the number of the first.
        own_size: Whether a range image's own size is taken in place of the sensor's, as a picture may do.

    Raises:
        InputError: nothing is there, or what is there cannot become such images.
    """
    label = spec.name if isinstance(spec, SourceOptions) else str(spec)
    options, file = (spec, None) if isinstance(spec, SourceOptions) else parse(label)
    if isinstance(spec, str | Path):
        options = replace(options, split=split, scenes=num or SCENES) if split or num else options
        reading = reading or own_reading(label) or usual_reading(label)
        if options.name == SIMULATED and options.root is not None:
            seed = int(options.root)
    assert reading is not None
    kind = SOURCES[options.name]
    if file is not None:
        refuse_other_samples(file.parent, reading.sensor)
        if own_size and (image := range_image(file)) is not None:
            reading = replace(reading, sensor=reading.sensor.resized(*image.shape[1:]))
        if reading.reflectance == AUTO:
            reading = replace(reading, reflectance=lacks_reflectance([file], reading.on_bad_scan) is None)
        return ScanSet(label, ScanFiles([file], reading, file.parent, about={"kind": "file"}), reading.sensor)
    if options.name == FOLDER:
        refuse_other_samples(Path(options.folder), reading.sensor)
    if reading.reflectance == AUTO:
        reading = replace(reading, reflectance=kind.lacks_reflectance(options, reading.on_bad_scan) is None)
    source = kind.open(options, reading, seed, first_scene)
    found = ScanSet(label, source, reading.sensor)
    return found if isinstance(spec, SourceOptions) or options.name == SIMULATED else found.limited(num)


def parse(text: str) -> tuple[SourceOptions, Path | None]:
    """The options that a user's name stands for, and the file where it is one.

    Raises:
        InputError: nothing is there.
    """
    path = Path(text).expanduser()
    kind, colon, rest = text.partition(":")
    if colon and kind in SOURCES:
        if kind == SIMULATED and not rest.isdigit():
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
    if (path / MANIFEST).is_file():
        return SourceOptions(PREPARED, str(path)), None
    return SourceOptions(FOLDER, str(samples_of(path) or path)), None


def find_drives(
    name: str, root: str | Path, split: str | None = None, drives: Sequence[str | int] | None = None
) -> list[Drive]:
    """The drives of a data set of scan files, in order; see `SourceOptions`.

    Raises:
        InputError: what `Layout.find_drives` refuses.
    """
    return SOURCES[name].find_drives(SourceOptions(name, str(root), split, None if drives is None else list(drives)))


# What scans say of themselves


def write_samples_note(folder: Path, reading: Reading, **about: Any) -> None:
    """Say in a folder of samples whose images they are: `open_scans` then needs no sensor and no size.

    Args:
        about: What else a reader may want to know, as plain values: encoding, seed, sampler.
    """
    content = {
        "format": "r2flow samples 1",
        "sensor": asdict(reading.sensor),
        "projection": reading.projection,
        "convention": reading.convention,
        **about,
    }
    with atomic_write(folder / SAMPLES, "w") as file:
        json.dump(content, file, indent=1)


def samples_of(run: Path) -> Path | None:
    """The samples of a run folder: its `samples`, else its only folder of samples; None where it is no run folder.

    Raises:
        InputError: it has several other folders of samples, or none.
    """
    if not (run / "config.yaml").is_file() and not (run / "checkpoints").is_dir():
        return None
    noted = {note.parent for note in run.glob(f"*/{SAMPLES}")}
    found = sorted(noted | {run / "samples"} if (run / "samples").is_dir() else noted)
    if not found:
        raise InputError(f"{run} is a run without samples; draw some: r2flow sample -c {run} --out {run / 'samples'}.")
    if len(found) == 1:
        return found[0]
    names = ", ".join(one.name for one in found)
    if run / "samples" not in found:
        raise InputError(f"{run} has several folders of samples ({names}); name one of them.")
    log.warning("%s has several folders of samples (%s): samples is taken", run, names)
    return run / "samples"


def own_reading(spec: str | Path) -> Reading | None:
    """How the images of scans were made, where they say so: prepared scans and samples. Other images they are not.

    Raises:
        InputError: nothing is there, or what it says of itself cannot be read.
    """
    options, _ = parse(str(spec))
    if options.name == PREPARED:
        recipe = read_manifest(Path(options.folder).expanduser()).recipe
        return Reading(_sensor(recipe.sensor), recipe.projection, recipe.convention, recipe.reflectance_scale)  # type: ignore[arg-type]
    return _noted(Path(options.folder)) if options.name == FOLDER else None


def usual_reading(spec: str | Path) -> Reading:
    """How scans of this kind usually become images."""
    kind = SOURCES[parse(str(spec))[0].name]
    return Reading(SENSORS[kind.sensor], reflectance_scale=kind.reflectance_scale)


def _noted(folder: Path) -> Reading | None:
    path = folder / SAMPLES
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return Reading(_sensor(content["sensor"]), content["projection"], content["convention"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} cannot be read ({error}); delete it and give --sensor and --size.") from None


def _sensor(described: Mapping[str, Any]) -> Sensor:
    plain: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in described.items()}
    return Sensor(**plain)


def refuse_other_samples(folder: Path, sensor: Sensor) -> None:
    """Refuse a folder whose note says that its images are of another sensor or size.

    Raises:
        InputError: it does.
    """
    own = _noted(folder)
    if own is None or (own.sensor.shape == sensor.shape and np.allclose(own.sensor.elevations, sensor.elevations)):
        return
    there, here = (f"{one.name} {one.shape[0]}x{one.shape[1]}" for one in (own.sensor, sensor))
    raise InputError(
        f"{folder} holds images of {there} (its {SAMPLES} says so), not of {here}: leave --sensor and --size out, and "
        "name no scans of another size beside them."
    )


# Prepared scans


def open_prepared(
    root: str | Path,
    sensor: Sensor,
    split: str | None = None,
    drives: Sequence[str | int] | None = None,
    reflectance: bool = True,
    projection: str = "spherical",
    convention: str = "centre",
) -> PreparedScans:
    """The scans of a folder that `r2flow prepare` has written, by the split and the drives of their data set.

    Raises:
        InputError: what `find_prepared` refuses, no reflectance where it is needed, or no such split or drive.
    """
    folder = Path(root).expanduser()
    manifest = find_prepared(folder, sensor, projection, convention)
    kind = SOURCES[manifest.recipe.layout] if manifest.recipe.layout in SOURCES else SourceKind()
    if split is None and drives is None:
        held = sorted({part for drive in manifest.drives if (part := kind.split_of(drive.name))})
        if len(held) > 1:
            log.warning("%s holds %s drives, and data.split=null takes all of them", folder, " and ".join(held))
    return PreparedScans(folder, manifest, _chosen(manifest, kind, split, drives), reflectance)


def _chosen(manifest: Manifest, kind: SourceKind, split: str | None, drives: Sequence[str | int] | None) -> np.ndarray:
    """The scans of a split and of some drives, numbered as they lie in the shards, (n,) int64."""
    ends = np.cumsum([len(drive.scans) for drive in manifest.drives])
    found = [(d, np.arange(end - len(d.scans), end)) for d, end in zip(manifest.drives, ends, strict=True)]
    if split is not None:
        if split not in kind.splits:
            known = ", ".join(kind.splits) or "none"
            raise InputError(f"no split named {split!r} in prepared {manifest.recipe.layout} scans; known: {known}.")
        found = [pair for pair in found if kind.split_of(pair[0].name) == split]
    if drives is not None:
        named = [named_drive([drive for drive, _ in found], str(name)) for name in drives]
        found = [pair for drive in named for pair in found if pair[0] is drive]
    usable = np.ones(manifest.recipe.scans, dtype=bool)
    usable[list(manifest.left_out)] = False
    numbers = np.concatenate([np.empty(0, dtype=np.int64), *(span for _, span in found)])
    chosen: np.ndarray = (np.cumsum(usable) - 1)[numbers[usable[numbers]]]
    if len(chosen) == 0:
        raise InputError(f"none of the {int(usable.sum())} prepared scans is of split={split!r}, drives={drives}.")
    return chosen


# The sets of scans that a run's `data` names


def described_sources(data: Mapping[str, Any]) -> list[SourceOptions]:
    """The sets of scans that a config's `data` names, to train on and to hold out; none where it names pairs."""
    options = DataOptions.of(data)
    if options.name == PAIRS:
        return []
    return [*split_parts(options), *held_out_options(options)]


def split_parts(options: DataOptions) -> list[PartOptions]:
    """The sets of scans to train on. What a part does not say is the run's, but for root, split and drives.

    Raises:
        InputError: a mixture without parts, an option that a part does not know, weights on some alone, or a part of
            which nobody said whether its test drives are meant too.
    """
    common = {f.name: getattr(options, f.name) for f in fields(SourceOptions)}
    if options.name != MIXED:
        return [PartOptions(**common)]
    if not options.parts:
        example = "[{name: kitti_360, root: FOLDER, split: train, weight: 3}, {name: folder, root: FOLDER, weight: 1}]"
        raise InputError(f"data=mixed needs its parts: data.parts='{example}'.")
    common |= {"root": None, "split": None, "drives": None}
    made = []
    for number, part in enumerate(options.parts):
        what = f"data.parts[{number}]"
        if not isinstance(part, Mapping):
            raise InputError(f"{what} must be a group of keys, as {{name: folder, root: FOLDER}}; found {part!r}.")
        check_options(what, PartOptions, part)
        if "name" not in part or part["name"] in (MIXED, PAIRS):
            raise InputError(f"{what} needs the name of a data set, found {part.get('name')!r}.")
        splits = SOURCES[part["name"]].splits
        if splits and "split" not in part:
            known = ", ".join(splits)
            raise InputError(
                f"{what}: {part['name']} has a standard split: give split, one of {known}, or null for all."
            )
        made.append(PartOptions(**{**common, **part}))
    if len({part.weight is None for part in made}) > 1:
        raise InputError("data.parts: give every part a weight, or none, for shares by size.")
    if sum(part.name == SIMULATED for part in made) > 1:
        raise InputError("data.parts: simulated scenes are numbered; give one simulated part, with all its scenes.")
    return made


def held_out_options(options: DataOptions) -> list[SourceOptions]:
    """`data.validation.data`: what it does not say is the run's, but for split and drives; empty where there is none.

    Raises:
        InputError: an option that it does not know, or several data sets.
    """
    other = options.held.data
    if other is None:
        return []
    check_options("data.validation.data", SourceOptions, other)
    common = {f.name: getattr(options, f.name) for f in fields(SourceOptions)}
    held = SourceOptions(**{**common, "split": None, "drives": None, **other})
    if held.name in (MIXED, PAIRS):
        raise InputError(f"data.validation.data must name one data set, found {held.name}; hold out a part of it.")
    return [held]


def resolve_reflectance(wanted: Any, data: Mapping[str, Any]) -> bool:
    """`encoding.reflectance` for a config's `data`: `auto` is true where each of its sets of scans has reflectance.

    Raises:
        InputError: another value than true, false and auto; or, under auto, a data set that cannot be opened.
    """
    if isinstance(wanted, bool):
        return wanted
    if wanted != AUTO:
        raise InputError(f"encoding.reflectance must be true, false or auto, found {wanted!r}.")
    for options in described_sources(data):
        lacking = SOURCES[options.name].lacks_reflectance(options, options.on_bad_scan)
        if lacking:
            log.info("encoding.reflectance=auto is false here, a flow of range alone: %s", lacking)
            return False
    log.info("encoding.reflectance=auto is true here: the scans have it")
    return True
