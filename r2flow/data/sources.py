"""Range images in metres, by number: from scan files, from the simulator, from memory."""

import hashlib
import json
import logging
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.labels import labels_beside, read_labels
from r2flow.lidar.projection import Convention, Projection, image_of, project_indices
from r2flow.lidar.recognition import other_sensor
from r2flow.lidar.scan_files import NoPointsError, Points, read_points, read_range_image
from r2flow.lidar.scan_files.points import FARTHEST
from r2flow.lidar.sensors import Sensor

if TYPE_CHECKING:
    from r2flow.simulator.folder import SimulatedFolder

log = logging.getLogger(__name__)

Read = TypeVar("Read")

AUTO = "auto"
LOOKED_AT = 3  # scans of a set, whose beams are compared with the sensor's


@dataclass(frozen=True)
class Reading:
    """How scans of any kind become images of one sensor.

    Attributes:
        projection, convention: As in `r2flow.lidar.projection.project`.
        reflectance_scale: The value in the files that means full reflectance; None guesses it from each file, which is
            good enough for a picture and for nothing else.
        reflectance: Whether images have reflectance: True needs it of every scan, False leaves it out, `auto` decides
            by `lacks_reflectance` when the scans are opened.
        on_bad_scan: What is done with a scan that cannot be used. `error` stops; `skip` takes the next usable scan in
            its place; `empty` stops too, but a scan without a return in the sensor's view is an empty image: a
            generator that makes such scans is judged by them.
        within_limits: Whether a range beyond the sensor's limits in a range image is a dropped ray, as it is in a file
            of points: what a model is given.
        columns: What the columns of files without names hold, as in `r2flow.lidar.scan_files.read_points`.
    """

    sensor: Sensor
    projection: Projection = "spherical"
    convention: Convention = "centre"
    reflectance_scale: float | None = 1.0
    reflectance: bool | str = AUTO
    on_bad_scan: str = "empty"
    within_limits: bool = False
    columns: tuple[str, ...] | None = None


class ScanSource(ABC):
    """Numbered range images, (2 or 1, H, W) float32: range in metres and reflectance of [0, 1], 0 where missing.

    A source of your own needs the four abstract methods; the others say what it can do besides.

    Attributes:
        slow: Whether an image takes long to get, so that those that fit are kept in memory.
        drawn: Whether a network draws the images when they are asked for: in this process alone, and no image twice
            where once will do.
        measured: Whether the points that the pixels stand for are known: of range images, prepared shards, samples and
            simulated scans they are not.
        drives: Numbers of the scans of each recording, by its name, where recordings are known.
    """

    slow = False
    drawn = False
    measured = False
    drives: Mapping[str, Sequence[int]] = {}

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def __getitem__(self, index: int) -> np.ndarray: ...

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """What each scan is called, wherever the data set lies."""

    @abstractmethod
    def subset(self, indices: Sequence[int]) -> "ScanSource":
        """Some of the scans as a source of their own, which never reaches for the others."""

    def batch(self, indices: Sequence[int]) -> Tensor:
        """Several scans at once, (B, 2 or 1, H, W)."""
        return torch.from_numpy(np.stack([self[index] for index in indices]))

    def with_points(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """An image, and the measured x, y, z of each pixel's point in metres, (3, H, W) float32, 0 where missing.

        Raises:
            InputError: the points are not known.
        """
        raise InputError(f"{self.names[index]} holds ranges alone, not the measured coordinates of its points.")

    def encoded(self, index: int, encoding: Encoding) -> Tensor:
        """A scan in model space, (C, H, W)."""
        return encoding.encode(torch.from_numpy(self[index]))

    def about(self) -> dict[str, Any]:
        """What a reader of a figure must know of the scans, as plain values; no path is among them."""
        return {}

    def identity(self) -> dict[str, Any] | None:
        """All that decides what the images are; None where nobody knows, and nothing of them is worth keeping."""
        return None

    def places(self) -> set[str]:
        """Where the scans lie, by which two sources are known to share some; empty where they lie nowhere."""
        return set()

    def files(self) -> dict[str, str | Path]:
        """The files that decide what the images are, by names that do not depend on where they lie."""
        return {}


class Projected(NamedTuple):
    """A scan file, and which of its points each pixel has kept.

    Attributes:
        image: (2 or 1, H, W).
        points: All of the file.
        pixels, chosen: The pixels that keep one, h W + w, and the index of that point, (M,) each.
    """

    image: np.ndarray
    points: Points
    pixels: np.ndarray
    chosen: np.ndarray

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Values of the kept points, (M, ...), at their pixels, (H, W, ...); 0 elsewhere."""
        shape = self.image.shape[1:]
        found = np.zeros((math.prod(shape), *values.shape[1:]), values.dtype)
        found[self.pixels] = values
        return found.reshape(*shape, *values.shape[1:])


def read_scan(
    path: str | Path,
    sensor: Sensor,
    projection: Projection = "spherical",
    convention: Convention = "centre",
    reflectance: bool = True,
    reflectance_scale: float | None = 1.0,
    columns: Sequence[str] | None = None,
) -> np.ndarray:
    """One scan file as a range image, (2, H, W); without `reflectance`, (1, H, W). The options are those of `Reading`.

    Raises:
        InputError: the file cannot be read, no point of it lies in the sensor's view and range (`NoPointsError`), or it
            has no reflectance, or one beyond the scale, where it is needed.
    """
    return read_projected(path, sensor, projection, convention, reflectance, reflectance_scale, columns).image


def read_projected(
    path: str | Path,
    sensor: Sensor,
    projection: Projection = "spherical",
    convention: Convention = "centre",
    reflectance: bool = True,
    reflectance_scale: float | None = 1.0,
    columns: Sequence[str] | None = None,
) -> Projected:
    """`read_scan` with the points behind its image.

    Raises:
        InputError: as `read_scan`.
    """
    points = read_points(path, columns)
    if points.dropped:
        log.warning(
            "%s: dropped %d points with NaN or infinite coordinates, or %g m and more away",
            path, points.dropped, FARTHEST,
        )  # fmt: skip
    if projection == "unfolding":
        points = points.with_lost_rays()
    scaled = _scaled_reflectance(path, points, reflectance_scale) if reflectance else None
    pixels, chosen, kept = project_indices(points.xyz, sensor, projection, convention, points.ring)
    image = image_of(sensor, pixels, kept, None if scaled is None else scaled[chosen])
    if not image[0].any():
        raise nothing_in_view(path, points, sensor)
    return Projected(image if reflectance else image[:1], points, pixels, chosen)


def nothing_in_view(path: str | Path, points: Points, sensor: Sensor) -> NoPointsError:
    """That a scan has no return that the sensor's image shows."""
    r = np.linalg.norm(points.xyz, axis=1)
    return NoPointsError(
        f"{path}: none of its {len(r)} points lies within {sensor.min_range:g}-{sensor.max_range:g} m and the "
        f"view of sensor '{sensor.name}' (ranges found: {r.min():.3g}-{r.max():.3g} m). "
        "Are its units metres and its sensor the configured one?"
    )


def read_labelled_scan(path: str | Path, sensor: Sensor, **options: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """The image of `read_scan`, and the semantic id of each pixel's return, (H, W) uint16, 0 where none was kept.

    The ids are None where no labels lie beside the scan.

    Raises:
        InputError: what `read_scan` refuses, or labels that are damaged or of another scan.
    """
    found = read_projected(path, sensor, **options)
    file = labels_beside(path)
    if file is None:
        return found.image, None
    labels = read_labels(file, path, found.points)[found.chosen].astype(np.uint16)
    return found.image, found.spread(labels)


def _no_reflectance(path: str | Path) -> InputError:
    return InputError(
        f"{path} has no reflectance and the config, the model or the first scan of its set has it. In training give "
        "encoding.reflectance=false for range alone, and no stage.init that has reflectance; in measuring give metrics "
        "of range."
    )


def _scaled_reflectance(path: str | Path, points: Points, scale: float | None) -> np.ndarray:
    if points.reflectance is None:
        raise _no_reflectance(path)
    highest = float(np.nan_to_num(points.reflectance).max(initial=0))
    if scale is None:
        scale = 1.0 if highest <= 1 else max(highest, 255.0)
    scaled = points.reflectance / np.float32(scale)
    # NaN compares false: it is refused like a value out of scale.
    if not (float(scaled.max(initial=0)) <= 1 + 1e-3 and float(scaled.min(initial=0)) >= 0):
        raise InputError(
            f"{path}: reflectance must lie in [0, {scale:g}], found up to {highest:g}. "
            "Say what means full reflectance there, often 255: data.reflectance_scale=255, or the reflectance_scale of "
            "its part of data.parts, or --reflectance-scale 255."
        )
    return scaled


def range_image(path: Path, shape: tuple[int, int] | None = None) -> np.ndarray | None:
    """The range image in a file, `read_range_image`; None where the file holds no range image.

    Raises:
        InputError: the file cannot be read, or its size is not the (H, W) of `shape`.
    """
    array = read_range_image(path)
    if array is not None and shape is not None and array.shape[1:] != shape:
        found, wanted = ("x".join(map(str, one)) for one in (array.shape[1:], shape))
        raise InputError(f"{path} is a range image of {found}, the sensor's is {wanted}; give --size {found}.")
    return array


def read_image(path: Path, reading: Reading) -> np.ndarray:
    """A scan file or a range image as an image, (2 or 1, H, W).

    Raises:
        InputError: it cannot be read, has another size, or no reflectance where that is needed; it has no return in the
            sensor's view and `reading.on_bad_scan` is not `empty`.
    """
    sensor, channels = reading.sensor, 1 + bool(reading.reflectance)
    image = range_image(path, sensor.shape)
    if image is None:
        found = _projected(path, reading)
        return _empty(reading) if found is None else found.image
    if len(image) < channels:
        raise _no_reflectance(path)
    image = image[:channels]
    return _within_limits(path, image, reading) if reading.within_limits else image


def _within_limits(path: Path, image: np.ndarray, reading: Reading) -> np.ndarray:
    nearest, farthest = reading.sensor.min_range, reading.sensor.max_range
    seen = (image[0] >= nearest) & (image[0] <= farthest)
    if not seen.any() and reading.on_bad_scan != "empty":
        found = image[0][image[0] > 0]
        ranges = f"; its ranges are {found.min():.4g} to {found.max():.4g}, in metres" if found.size else ""
        raise NoPointsError(f"{path} has no return from {nearest:g} to {farthest:g} m{ranges}.")
    image = np.where(seen, image, np.float32(0))
    highest = image[1:].max(initial=0)
    if highest > 1 + 1e-3:
        raise InputError(
            f"{path}: reflectance of a range image lies in [0, 1], found up to {highest:.4g}; divide it by what means "
            "full reflectance."
        )
    image[1:] = image[1:].clip(0, 1)
    return image


def read_points_image(path: Path, reading: Reading) -> tuple[np.ndarray, np.ndarray]:
    """A file of points as an image, (2 or 1, H, W), and its pixels' points in metres, (3, H, W) float32, 0 for none.

    Raises:
        InputError: as `read_image`.
    """
    found = _projected(path, reading)
    if found is None:
        return _empty(reading), np.zeros((3, *reading.sensor.shape), np.float32)
    xyz = found.spread(found.points.xyz[found.chosen].astype(np.float32))
    return found.image, np.ascontiguousarray(np.moveaxis(xyz, -1, 0))


def _projected(path: Path, reading: Reading) -> Projected | None:
    """A file of points; None for one without a return where that may be."""
    how = reading.projection, reading.convention, bool(reading.reflectance), reading.reflectance_scale, reading.columns
    try:
        return read_projected(path, reading.sensor, *how)
    except NoPointsError:
        if reading.on_bad_scan != "empty":
            raise
        return None


def _empty(reading: Reading) -> np.ndarray:
    return np.zeros((1 + bool(reading.reflectance), *reading.sensor.shape), np.float32)


def lacks_reflectance(
    paths: Iterable[str | Path], on_bad_scan: str = "error", columns: Sequence[str] | None = None
) -> str | None:
    """Why scan files count as files without reflectance; None where they have it.

    The one rule, for training, measuring and pictures: the first scan that has a return decides, and reflectance that
    is 0 throughout is none, because a KITTI .bin has a column for it whatever the sensor reports.

    Raises:
        InputError: a scan that cannot be read. With `on_bad_scan="skip"` it is passed over; with `empty`, one alone
            that has no point.
    """
    for path in paths:
        try:
            found = stored_reflectance(path, columns)
        except InputError as error:
            if on_bad_scan == "error" or (on_bad_scan == "empty" and not isinstance(error, NoPointsError)):
                raise
            continue
        if found is None:
            return f"{path} has no reflectance"
        if found.size:
            return None if found.any() else f"the reflectance in {path} is 0 throughout"
    return "no scan has a return"


def warn_of_other_sensor(paths: Sequence[str | Path], reading: Reading, root: str | Path) -> None:
    """Say in one line that scan files do not look like a sensor's, and which sensor they fit (`other_sensor`).

    Range images have no beams, and files that cannot be read are met again when their turn comes.

    Raises:
        InputError: the scans are for a model (`reading.within_limits`), and those of no spinning LiDAR.
    """
    scans, sensor = [], reading.sensor
    for number in spread(len(paths), LOOKED_AT):
        with suppress(InputError):
            scans.append(read_points(paths[number], reading.columns))
    found = other_sensor(scans, sensor) if scans else None
    if found is None:
        return
    seen, name, hopeless = found
    if hopeless and reading.within_limits:
        raise InputError(f"{root}: {seen}.")
    edges = sensor.row_edges
    advice = f"give the right one, or estimate it: r2flow sensor {root} --out mine.yaml"
    if name is not None and name != sensor.name:
        advice = f"they fit '{name}': sensor={name} in training, --sensor {name} in verbs"
    log.warning(
        "%s: the scans do not look like those of sensor '%s', which sees %+.1f to %+.1f degrees: %s; %s",
        root, sensor.name, edges[0], edges[-1], seen, advice,
    )  # fmt: skip


def stored_reflectance(path: str | Path, columns: Sequence[str] | None = None) -> np.ndarray | None:
    """The reflectance of all returns of a scan file or a range image, as it is stored; None where there is none."""
    image = range_image(Path(path))
    if image is None:
        return read_points(path, columns).reflectance
    return image[1][image[0] > 0] if len(image) > 1 else None


class ScanFiles(ScanSource):
    """Scan files of any format and range images, side by side, each read when it is asked for.

    With `on_bad_scan="skip"` a file that cannot be used is left out with a warning: the next usable file of this source
    takes its place, the same one in every process.

    A scan is named by its path below the data set's `root`.
    """

    slow = True

    def __init__(
        self,
        paths: Sequence[str | Path],
        reading: Reading,
        root: str | Path = "",
        drives: Mapping[str, Sequence[int]] | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.paths, self.reading, self.root = list(paths), reading, root
        self.drives, self.described = drives or {}, about or {}
        self.bad: set[int] = set()

    @cached_property
    def measured(self) -> bool:  # type: ignore[override]
        arrays = (path for path in self.paths if str(path).lower().endswith((".npy", ".npz")))
        return next((range_image(Path(path)) is None for path in arrays), True)

    @property
    def names(self) -> list[str]:
        below = os.path.join(self.root, "")
        return [str(path).removeprefix(below) for path in self.paths]

    def subset(self, indices: Sequence[int]) -> "ScanFiles":
        return ScanFiles([self.paths[i] for i in indices], self.reading, self.root, about=self.described)

    def files(self) -> dict[str, str | Path]:
        return dict(zip(self.names, self.paths, strict=True))

    def about(self) -> dict[str, Any]:
        return {**self.described, "files": self._digest[:12], "reflectance": bool(self.reading.reflectance)}

    def identity(self) -> dict[str, Any]:
        return {"files": self._digest, **asdict(self.reading), "sensor": self.reading.sensor.described()}

    @cached_property
    def _digest(self) -> str:
        found = [(name, os.stat(path)) for name, path in zip(self.names, self.paths, strict=True)]
        stats = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in found]
        # Some contents, too: unpacked archives have equal names, sizes and times.
        some = []
        for i in spread(len(self.paths), 8):
            if os.path.isfile(self.paths[i]):  # a pipe would hang, a device never end
                with open(self.paths[i], "rb") as file:
                    some.append(hashlib.file_digest(file, "sha256").hexdigest())
        return hashlib.sha256(json.dumps([stats, some]).encode()).hexdigest()

    def places(self) -> set[str]:
        real = os.path.realpath(self.root)  # once for all of them: on a network disk it takes its time
        return {os.path.join(real, name) for name in self.names}

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        return self._first_usable(index, lambda path: read_image(path, self.reading))

    def with_points(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return self._first_usable(index, lambda path: read_points_image(path, self.reading))

    def _first_usable(self, index: int, read: Callable[[Path], Read]) -> Read:
        """What is read of a file, or with `on_bad_scan="skip"` of the first usable one from there on."""
        if self.reading.on_bad_scan != "skip":
            return read(Path(self.paths[index]))
        for candidate in (*range(index, len(self)), *range(index)):
            if candidate in self.bad:
                continue
            try:
                return read(Path(self.paths[candidate]))
            except InputError as error:
                self.bad.add(candidate)
                log.warning("left out: %s", error)
        raise InputError(f"all {len(self.paths)} scans were left out as unusable; see the warnings above.")


class SimulatedScans(ScanSource):
    """Scenes of the simulator under one seed, by their numbers.

    Args:
        folder: Where they are kept, as `r2flow simulate --format npy` does: each is made when it is asked for first.

    Raises:
        InputError: the folder holds scans of another sensor, seed or revision of the simulator.
    """

    def __init__(
        self,
        sensor: Sensor,
        seed: int,
        scenes: Sequence[int],
        reflectance: bool = True,
        folder: str | Path | None = None,
    ) -> None:
        self.sensor, self.seed, self.scenes, self.reflectance, self.folder = sensor, seed, scenes, reflectance, folder
        if self._kept is not None:
            self._kept.check()

    @property
    def slow(self) -> bool:  # type: ignore[override]
        return self.folder is None

    @cached_property
    def _kept(self) -> "SimulatedFolder | None":
        from r2flow.simulator.folder import SimulatedFolder

        return None if self.folder is None else SimulatedFolder(Path(self.folder), self.sensor, self.seed, ("npy",))

    @property
    def names(self) -> list[str]:
        return [f"scene {scene}" for scene in self.scenes]

    def subset(self, indices: Sequence[int]) -> "SimulatedScans":
        scenes = [self.scenes[i] for i in indices]
        return SimulatedScans(self.sensor, self.seed, scenes, self.reflectance, self.folder)

    def about(self) -> dict[str, Any]:
        return {"kind": "simulated", "seed": self.seed, "scenes": len(self), "reflectance": self.reflectance}

    def identity(self) -> dict[str, Any]:
        from r2flow import simulator

        numbers = hashlib.sha256(np.asarray(self.scenes, dtype=np.int64).tobytes()).hexdigest()[:16]
        return {**self.about(), "numbers": numbers, "simulator": simulator.REVISION, "sensor": self.sensor.described()}

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> np.ndarray:
        from r2flow.simulator import simulate

        scene, channels = self.scenes[index], 1 + self.reflectance
        if self._kept is None:
            return simulate(self.sensor, self.seed, scene).image[:channels]
        if self._kept.missing([scene]):
            self._kept.begin()
            self._kept.write(scene)
        (path,) = self._kept.files(scene)
        image = range_image(path, self.sensor.shape)
        if image is None:
            raise InputError(f"{path} is damaged; remove it, and it is made again.")
        return image[:channels]


class InMemory(ScanSource):
    """Images in memory, (N, 2 or 1, H, W), and their names."""

    def __init__(self, images: np.ndarray, names: Sequence[str]) -> None:
        self.images, self._names = images, names

    @property
    def names(self) -> Sequence[str]:
        return self._names

    def subset(self, indices: Sequence[int]) -> "InMemory":
        return InMemory(self.images[list(indices)], [self.names[i] for i in indices])

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.images[index]


def spread(count: int, most: int) -> list[int]:
    """At most `most` numbers of range(count), evenly spread and in order."""
    if count <= most:
        return list(range(count))
    return [math.floor((i + 0.5) * count / most) for i in range(most)]


def holdout_block(count: int, share: float, starts: Sequence[int] = ()) -> tuple[range, range]:
    """(training, validation) numbers: about the last `share` of the scans, in one contiguous block.

    Never a random choice of frames: neighbours in a drive are near-duplicates of each other. Where whole drives, which
    begin at the numbers `starts`, come within half of the share at the end, they are held out, so that no scan has a
    neighbour on the other side; else exactly the share is.
    """
    if not 0 <= share < 1:
        raise InputError(f"data.validation.share must lie in [0, 1), found {share}.")
    held = min(math.ceil(count * share), count - 1)
    whole = [count - start for start in starts if start > 0 and abs(count - start - held) <= held / 2]
    held = min(whole, key=lambda one: abs(one - held), default=held) if held else 0
    return range(count - held), range(count - held, count)
