"""Names of scans, each looked up once: what the scans are and where they lie."""

import os
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from r2flow.base.errors import InputError
from r2flow.base.registry import Config, did_you_mean
from r2flow.data.kinds import SOURCES, SourceKind
from r2flow.data.layouts import Drive
from r2flow.data.options import FOLDER, PREPARED, SIMULATED, SourceOptions
from r2flow.data.reading import AUTO, Reading
from r2flow.data.sources import ScanSource, spread
from r2flow.lidar.scan_files import read_range_image
from r2flow.lidar.sensors import Sensor
from r2flow.model.shipped import MODELS
from r2flow.store import MANIFEST, manifest_of

_SCENES = 1000  # default number of simulated scans


@dataclass(eq=False)
class Described:
    """A set of scans by its name. Drives and manifests are found at their first use, and kept."""

    label: str  # the name, as given
    options: SourceOptions
    file: Path | None = None  # if the name is a file
    seed: int = 0  # of simulated scans
    first_scene: int = 0  # likewise
    dataset: Any = None  # of a user's own, if it is not made by its name

    @property
    def kind(self) -> SourceKind:
        return SOURCES[self.options.name]

    @cached_property
    def drives(self) -> list[Drive]:
        """The drives of scan files, in order."""
        return self.kind.find_drives(self.options)

    @cached_property
    def paths(self) -> list[str]:
        """The scan files, in order."""
        if self.file:
            return [str(self.file)]
        return [path for drive in self.drives for path in drive.scans]

    def some(self, most: int) -> list[str]:
        """At most `most` of the scan files, evenly spread."""
        return [self.paths[number] for number in spread(len(self.paths), most)]

    @cached_property
    def manifest(self) -> Config:
        """The manifest that r2flow wrote into the folder of the scans; empty if there is none."""
        return manifest_of(self.options.folder) if self.options.name in (PREPARED, FOLDER) else {}

    @property
    def stored(self) -> Reading | None:
        """The stored reading of scans that r2flow wrote (prepared, sampled or simulated); None for
        other scans.
        """
        stored = Reading.stored(self.manifest)
        if stored and self.options.name == PREPARED:
            stored = replace(stored, reflectance=AUTO, labels=False, within_limits=False)
        return stored

    @cached_property
    def manifests(self) -> list[Config]:
        """The manifests that r2flow wrote, if it wrote all scans of a folder: its own, or those of
        all folders with scans below it. The reflectance of such scans is in [0, 1].
        """
        if self.options.name != FOLDER or not self.options.folder.is_dir():
            return []
        if self.manifest:
            return [self.manifest]
        below = {str(self.options.folder)}
        with suppress(InputError):  # reported when the scans are opened
            below = {os.path.dirname(path) for path in self.paths}
        if str(self.options.folder) in below:
            return []
        found = [manifest_of(folder) for folder in sorted(below)]
        return found if all(found) else []

    @property
    def written_scale(self) -> float | None:
        """Full reflectance in files that r2flow wrote: 1, or of completed scans that of the scans;
        None if these differ.
        """
        scales = set(self.manifest.get("reflectance_scales", {"": 1.0}).values())
        return float(scales.pop()) if len(scales) == 1 else None

    def scale(self, of_sensor: float | None) -> float | None:
        """Default value of full reflectance in the files; `of_sensor`: that of the sensor, if
        known. None: that of each file is estimated.
        """
        if self.options.name == FOLDER:
            return self.written_scale if self.manifests else of_sensor or 1.0
        return self.kind.reflectance_scale

    def open(self, reading: Reading) -> ScanSource:
        """Open the scans by `SourceKind.open`, after resolving `reading.reflectance`."""
        options = self.options
        if options.name == FOLDER:
            # points can be projected for any sensor
            if self.file is None or read_range_image(self.file) is not None:
                self._refuse_other_samples(reading.sensor)
            if self.manifests:
                reading = replace(reading, reflectance_scale=self.written_scale)
        if reading.reflectance == AUTO:
            lacking = self.kind.lacks_reflectance(self, reading)
            reading = replace(reading, reflectance=lacking is None)
        source = self.kind.open(self, reading)
        if not len(source):
            part = f"split={options.split!r}, drives={options.drives}"
            raise InputError(f"{options.root or options.name} holds no usable scan of {part}.")
        return source

    def _refuse_other_samples(self, sensor: Sensor) -> None:
        """Refuse samples or completed scans, which are images of one size, of another sensor or
        size.
        """
        images = self.manifest.get("format") in ("r2flow samples", "r2flow answers")
        stored = self.stored
        if images and stored and not stored.sensor.same_image(sensor):
            raise InputError(
                f"{self.options.folder} holds images of {stored.sensor} (in its {MANIFEST}), not "
                f"of {sensor}: give no other --sensor or --size, no scans of another sensor next "
                "to them, and for a model of another sensor point clouds (.ply, .bin)."
            )


Spec = str | Path | Described


def describe(
    spec: Spec, split: str | None = None, drives: list[str | int] | None = None
) -> Described:
    """Look a name of scans up.

    Args:
        spec: A scan file, a range image (.npy) or a folder of them, a folder of `r2flow prepare`,
            `NAME:ROOT` with a name of `SOURCES`, `simulated:SEED`, a folder of samples, or a run
            folder (its samples).
        split: Part of the data set's standard split; None: all.
        drives: Names or numbers of the drives to take; None: all.

    Raises:
        InputError: there is no such file, folder or data set.
    """
    if isinstance(spec, Described):
        return spec
    text = str(spec)
    path = Path(text).expanduser()
    kind, colon, root = text.partition(":")
    simulated = bool(colon) and kind == SIMULATED
    if split and (simulated or path.is_file()):
        raise InputError(f"{text} has no split: leave {split!r} out.")
    if simulated:
        if not root.isdecimal():
            raise InputError(
                f"simulated scans are named by their seed, as simulated:0; found {text!r}."
            )
        options = SourceOptions(kind, drives=drives, scenes=_SCENES)
        return Described(text, options, seed=int(root))
    if colon and kind in SOURCES:
        return Described(text, SourceOptions(kind, root, split, drives))
    if path.is_file():
        return Described(text, SourceOptions(FOLDER, str(path.parent)), path)
    if not path.exists():
        raise _not_found(text, path)
    if (path / "config.yaml").is_file() or (path / "checkpoints").is_dir():  # of a run
        run = path
        path = run / "samples"
        if not path.is_dir():
            raise InputError(
                f"{run} is a run without samples; draw some: r2flow sample {run} --out {path}."
            )
    scans = Described(text, SourceOptions(FOLDER, str(path), split, drives))
    if scans.manifest.get("format") == "r2flow scans":
        scans.options = replace(scans.options, name=PREPARED)
    return scans


def _not_found(text: str, path: Path) -> InputError:
    kind, colon, _ = text.partition(":")
    if colon and "/" not in kind and "\\" not in kind:
        SOURCES[kind]  # not known
    if text in MODELS:
        return InputError(f"{text} is a model; sample it first: r2flow sample {text} --out scans.")
    if path.is_symlink():
        return InputError(f"{path} is a broken link to {path.readlink()}.")
    hint = did_you_mean(path.name, [*MODELS, *(other.name for other in path.parent.glob("*"))])
    return InputError(
        f"{path} does not exist. Give a scan, a folder, NAME:FOLDER, simulated:SEED or a run.{hint}"
    )
