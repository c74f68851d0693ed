"""Range images in metres, by number: from scan files, from the simulator, from memory."""

import logging
import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.labels import labels_beside, read_labels
from r2flow.lidar.projection import Convention, Projection, project, project_indices
from r2flow.lidar.scan_files import Points, read_points
from r2flow.lidar.scan_files.points import FARTHEST
from r2flow.lidar.sensors import Sensor

log = logging.getLogger(__name__)


class ScanSource(Protocol):
    """Numbered range images, (2, H, W) float32: range in metres and reflectance of [0, 1], 0 where missing."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> np.ndarray: ...

    @property
    def names(self) -> Sequence[str]:
        """What each scan is called, wherever the data set lies."""
        ...

    def subset(self, indices: Sequence[int]) -> "ScanSource":
        """Some of the scans as a source of their own, which never reaches for the others."""
        ...


def read_scan(
    path: str | Path,
    sensor: Sensor,
    projection: Projection = "spherical",
    convention: Convention = "centre",
    reflectance: bool = True,
    reflectance_scale: float = 1.0,
) -> np.ndarray:
    """One scan file as a range image.

    Args:
        reflectance: Whether the image needs reflectance; without it, (1, H, W) is returned.
        reflectance_scale: The value in the file that means full reflectance (1 in KITTI, often 255).

    Raises:
        InputError: the file cannot be read, no point of it lies in the sensor's view and range, or it has
            no reflectance, or one beyond the scale, where it is needed.
    """
    points = read_points(path)
    if points.dropped:
        log.warning(
            "%s: dropped %d points with NaN or infinite coordinates, or %g m and more away",
            path, points.dropped, FARTHEST,
        )  # fmt: skip
    scaled = _scaled_reflectance(path, points, reflectance_scale) if reflectance else None
    image = project(points.xyz, scaled, sensor, projection, convention, points.ring)
    if not image[0].any():
        r = np.linalg.norm(points.xyz, axis=1)
        raise InputError(
            f"{path}: none of its {len(r)} points lies within {sensor.min_range:g}-{sensor.max_range:g} m and the "
            f"view of sensor '{sensor.name}' (ranges found: {r.min():.3g}-{r.max():.3g} m). "
            "Are its units metres and its sensor the configured one?"
        )
    return image if reflectance else image[:1]


def read_labelled_scan(path: str | Path, sensor: Sensor, **options: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """One scan file as a range image, and the semantic id of each pixel's return, where labels lie beside the scan.

    Args:
        options: Keyword options of `read_scan`.

    Returns:
        The image of `read_scan`, and ids, (H, W) uint16, 0 where no return was kept; None where there are no labels.

    Raises:
        InputError: what `read_scan` refuses, or labels that are damaged or of another scan.
    """
    image = read_scan(path, sensor, **options)
    file = labels_beside(path)
    if file is None:
        return image, None
    points = read_points(path)
    projection, convention = options.get("projection", "spherical"), options.get("convention", "centre")
    pixels, chosen, _ = project_indices(points.xyz, sensor, projection, convention, points.ring)
    labels = np.zeros(math.prod(sensor.shape), dtype=np.uint16)
    labels[pixels] = read_labels(file, path, points)[chosen]
    return image, labels.reshape(sensor.shape)


def _scaled_reflectance(path: str | Path, points: Points, scale: float) -> np.ndarray:
    if points.reflectance is None:
        raise InputError(
            f"{path} has no reflectance and the config wants it. "
            "Set encoding.reflectance=false for a model of range alone, or auto to let the scans decide."
        )
    scaled = points.reflectance / np.float32(scale)
    highest = float(scaled.max(initial=0))
    # NaN compares false: it is refused like a value out of scale.
    if not (highest <= 1 + 1e-3 and float(scaled.min(initial=0)) >= 0):
        found = float(points.reflectance.max(initial=0))
        raise InputError(
            f"{path}: reflectance must lie in [0, {scale:g}], found up to {found:g}. "
            "Say what means full reflectance there, often 255: data.reflectance_scale=255, or the reflectance_scale of "
            "its part of data.parts, or --reflectance-scale 255."
        )
    return scaled


class ScanFiles:
    """Scan files, projected when asked for.

    A file that cannot be used stops the run (`on_bad_scan="error"`) or is left out with a warning
    (`"skip"`): the next usable file of this source takes its place, the same one in every process.

    Args:
        paths: The files.
        root: The folder of the data set; a scan is named by its path below it.
        options: Keyword options of `read_scan`.
    """

    def __init__(
        self,
        paths: Sequence[str | Path],
        sensor: Sensor,
        on_bad_scan: str = "error",
        root: str | Path = "",
        **options: Any,
    ) -> None:
        if on_bad_scan not in ("error", "skip"):
            raise InputError(f"data.on_bad_scan must be 'error' or 'skip', found {on_bad_scan!r}.")
        self.paths, self.sensor, self.on_bad_scan, self.options = list(paths), sensor, on_bad_scan, options
        self.root = root
        self.bad: set[int] = set()

    @property
    def names(self) -> list[str]:
        below = os.path.join(self.root, "")
        return [str(path).removeprefix(below) for path in self.paths]

    def subset(self, indices: Sequence[int]) -> "ScanFiles":
        return ScanFiles([self.paths[i] for i in indices], self.sensor, self.on_bad_scan, self.root, **self.options)

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        for offset in range(len(self.paths)):
            candidate = (index + offset) % len(self.paths)
            if candidate in self.bad:
                continue
            try:
                return read_scan(self.paths[candidate], self.sensor, **self.options)
            except InputError as error:
                if self.on_bad_scan == "error":
                    raise
                self.bad.add(candidate)
                log.warning("left out: %s", error)
        raise InputError(f"all {len(self.paths)} scans were left out as unusable; see the warnings above.")


class SimulatedScans:
    """Scenes of the simulator under one seed, by their numbers."""

    def __init__(self, sensor: Sensor, seed: int, scenes: Sequence[int], reflectance: bool = True) -> None:
        self.sensor, self.seed, self.scenes, self.reflectance = sensor, seed, scenes, reflectance

    @property
    def names(self) -> list[str]:
        return [f"scene {scene}" for scene in self.scenes]

    def subset(self, indices: Sequence[int]) -> "SimulatedScans":
        return SimulatedScans(self.sensor, self.seed, [self.scenes[i] for i in indices], self.reflectance)

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> np.ndarray:
        from r2flow.simulator import simulate

        return simulate(self.sensor, self.seed, self.scenes[index]).image[: 1 + self.reflectance]


def encoded(source: ScanSource, index: int, encoding: Encoding) -> Tensor:
    """A scan in model space, (C, H, W); a source that knows a shorter way there than by metres goes it."""
    shorter = getattr(source, "encoded", None)
    return encoding.encode(torch.from_numpy(source[index])) if shorter is None else shorter(index, encoding)


class InMemory:
    """A source read once and kept; what it gives in memory is what it gives from its files.

    Args:
        track: Wraps the numbers while they are read, for a progress bar.
    """

    def __init__(self, source: ScanSource, track: Callable[[range], Iterable[int]] = lambda numbers: numbers) -> None:
        self.images = np.stack([source[index] for index in track(range(len(source)))])
        self.names: Sequence[str] = source.names

    def subset(self, indices: Sequence[int]) -> "InMemory":
        chosen = InMemory.__new__(InMemory)
        chosen.images, chosen.names = self.images[list(indices)], [self.names[i] for i in indices]
        return chosen

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

    Never a random choice of frames: neighbours in a drive are near-duplicates of each other. Where whole drives at the
    end come within half of the share, they are held out, so that no scan has a neighbour on the other side; else
    exactly the share is.

    Args:
        starts: Number of the first scan of each drive.
    """
    if not 0 <= share < 1:
        raise InputError(f"data.validation.share must lie in [0, 1), found {share}.")
    held = min(math.ceil(count * share), count - 1)
    whole = [count - start for start in starts if start > 0 and abs(count - start - held) <= held / 2]
    held = min(whole, key=lambda one: abs(one - held), default=held) if held else 0
    return range(count - held), range(count - held, count)
