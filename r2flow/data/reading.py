"""Reading of scan files and range images as images of a sensor."""

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from r2flow.base.errors import InputError, naming
from r2flow.base.registry import Config, Options
from r2flow.data.reflectance import no_reflectance, scaled_reflectance
from r2flow.lidar.labels import (
    SEMANTIC_KITTI,
    LabelList,
    common_classes,
    label_list,
    labels_beside,
    read_labels,
)
from r2flow.lidar.projection import Convention, Projection, project_indices, scatter
from r2flow.lidar.scan_files import (
    NoPointsError,
    Points,
    points_beside,
    read_cloud,
    read_points,
    read_range_image,
)
from r2flow.lidar.sensors import Sensor

_log = logging.getLogger(__name__)

AUTO = "auto"


@dataclass(frozen=True)
class Reading:
    """How scans become images of a sensor."""

    sensor: Sensor
    projection: Projection = "spherical"  #: as in `r2flow.lidar.projection.project`
    convention: Convention = "centre"  #: likewise
    #: value in the files of full reflectance; None estimates it from each file
    reflectance_scale: float | None = 1.0
    #: Whether images have reflectance: True requires it of every scan; `auto`: see
    #: `lacks_reflectance`.
    reflectance: bool | str = AUTO
    labels: bool = False  #: whether images end with the common class of each ray
    #: Treatment of unusable scans. `error` raises; `skip` takes the next usable scan; `empty`
    #: raises, but returns an empty image for a scan without a return in the sensor's view.
    on_bad_scan: str = "empty"
    #: Whether ranges of a range image beyond the sensor's limits are dropped, as those of points
    #: are.
    within_limits: bool = False
    columns: tuple[str, ...] | None = None  #: as in `r2flow.lidar.scan_files.read_points`
    label_ids: LabelList = SEMANTIC_KITTI  #: of label files, as `label_list` takes it

    def __post_init__(self) -> None:
        object.__setattr__(self, "label_ids", label_list(self.label_ids))

    def described(self) -> Config:
        """All fields as plain values, for manifests."""
        ids = self.label_ids.described
        values = {**vars(self), "sensor": self.sensor.described(), "label_ids": ids}
        plain: Config = json.loads(json.dumps(values))  # turns tuples into lists
        return plain

    @classmethod
    def of(cls, described: Options) -> "Reading":
        """The reading of a manifest; missing fields have their defaults."""
        reading = cls(**{**described, "sensor": Sensor(**described["sensor"])})
        return replace(reading, columns=reading.columns and tuple(reading.columns))

    @classmethod
    def stored(cls, manifest: Options) -> "Reading | None":
        """The reading in a manifest that r2flow wrote; None if it has none."""
        described = manifest.get("recipe", {}).get("reading")
        return described and cls.of(described)


@dataclass(frozen=True)
class _Projected:
    """The points of a file as an image, (2 or 1, H, W)."""

    image: np.ndarray
    points: Points  # all points of the file
    pixels: np.ndarray  # that have a point, h W + w, (M,)
    numbers: np.ndarray  # of the points of these pixels, (M,)


def _project_file(path: str | Path, reading: Reading) -> _Projected:
    """Read a file of points as an image."""
    try:
        return _projected(path, reading)
    except NoPointsError:
        if reading.on_bad_scan != "empty":
            raise
    shape = (1 + bool(reading.reflectance), *reading.sensor.shape)
    none = np.zeros(0, np.int64)
    return _Projected(np.zeros(shape, np.float32), Points(np.zeros((0, 3), np.float32)), none, none)


def _projected(path: str | Path, reading: Reading) -> _Projected:
    sensor = reading.sensor
    points = read_points(path, reading.columns)
    if reading.projection == "unfolding":
        points = points.with_lost_rays()
    scaled = []
    if reading.reflectance:
        scaled = [scaled_reflectance(path, points, reading.reflectance_scale)[0]]
    with naming(path):
        pixels, numbers, r = project_indices(
            points.xyz, sensor, reading.projection, reading.convention, points.ring
        )
    if not r.any():
        raise nothing_in_view(path, points, sensor)
    image = scatter(sensor, pixels, [r, *(channel[numbers] for channel in scaled)])
    return _Projected(image, points, pixels, numbers)


def nothing_in_view(path: str | Path, points: Points, sensor: Sensor) -> NoPointsError:
    """The error for a scan without a return in the sensor's view."""
    r = np.linalg.norm(points.xyz, axis=1)
    return NoPointsError(
        f"{path}: none of its {len(r)} points lies within "
        f"{sensor.min_range:g}-{sensor.max_range:g} m and the "
        f"view of sensor '{sensor.name}' (ranges found: {r.min():.3g}-{r.max():.3g} m). "
        "Are its units metres and its sensor the configured one?"
    )


def read_image(path: Path, reading: Reading) -> np.ndarray:
    """Read a scan file or a range image as an image, (2 or 1, H, W), and with labels a channel
    more: the common class of each ray, 0 without a file of labels.

    Labels are those of points: of a range image, of the file of points next to it.
    """
    if reading.labels:
        path = points_beside(path)
    image = read_range_image(path)
    if image is not None:
        image = _as_read(path, image, reading)
    elif reading.labels and (file := labels_beside(path)):
        image, ids = read_labelled_scan(path, file, reading, reading.label_ids)
        return np.concatenate([image, common_classes(ids)[None]])
    else:
        image = _project_file(path, reading).image
    return np.concatenate([image, np.zeros_like(image[:1])]) if reading.labels else image


def read_labelled_scan(
    path: Path, file: Path, reading: Reading, ids: LabelList | None = SEMANTIC_KITTI
) -> tuple[np.ndarray, np.ndarray]:
    """The image of a scan, and from its label file each pixel's semantic id, (H, W) uint16, 0 for
    no return; `ids` as in `read_labels`.
    """
    projected = _project_file(path, reading)
    labels = read_labels(file, path, projected.points, ids)[projected.numbers]
    semantic = scatter(reading.sensor, projected.pixels, [labels])[0]
    return projected.image, semantic.astype(np.uint16)


def read_errors(path: Path, reading: Reading) -> np.ndarray | None:
    """`error_68` of the point of each pixel of a completed scan, metres, (1, H, W) float32: 0 of a
    measured one and without return, NaN of an added one without error; None for other scans.
    """
    if read_range_image(path) is not None:
        return None
    cloud = read_cloud(path, reading.columns)
    measured = cloud.column("measured")
    if measured is None:
        return None
    errors = cloud.column("error_68")
    if errors is None:
        errors = np.where(measured, 0, np.nan)
    projected = _project_file(path, reading)
    if projected.points.kept is not None:
        errors = errors[projected.points.kept]
    return scatter(reading.sensor, projected.pixels, [errors[projected.numbers]])


def _as_read(path: Path, image: np.ndarray, reading: Reading) -> np.ndarray:
    """The channels of a range image that are read, within the sensor's limits if they count."""
    channels = 1 + bool(reading.reflectance)
    if image.shape[1:] != reading.sensor.shape:
        size = "x".join(map(str, image.shape[1:]))
        raise InputError(
            f"{path} is a range image of {size}, sensor {reading.sensor}; give --size {size}, or "
            "its points (.bin, .ply, .pcd), which take any size."
        )
    if len(image) < channels:
        raise no_reflectance(path)
    image = image[:channels]
    if not reading.within_limits:
        return image
    r = image[0]
    nearest = reading.sensor.min_range
    farthest = reading.sensor.max_range
    seen = (r >= nearest) & (r <= farthest)
    if not seen.any() and reading.on_bad_scan != "empty":
        raise NoPointsError(
            f"{path} has no return from {nearest:g} to {farthest:g} m; its ranges are up to "
            f"{r.max():.4g} m."
        )
    image = np.where(seen, image, np.float32(0))
    highest = image[1:].max(initial=0)
    if highest > 1 + 1e-3:
        raise InputError(
            f"{path}: reflectance of a range image lies in [0, 1], found up to {highest:.4g}; "
            "divide by full reflectance."
        )
    image[1:] = image[1:].clip(0, 1)
    return image


def read_points_image(path: Path, reading: Reading) -> tuple[np.ndarray, np.ndarray]:
    """Read points as an image, (2 or 1, H, W), and its pixels' points in metres, (3, H, W) float32,
    0 for no return.
    """
    projected = _project_file(path, reading)
    xyz = projected.points.xyz[projected.numbers]
    return projected.image, scatter(reading.sensor, projected.pixels, xyz.T)


def labelled(paths: Sequence[str]) -> int:
    """The number of scan files with labels; warns of those without, if some have them."""
    missing = []
    for path in paths:
        scan = points_beside(Path(path))
        if scan.suffix.lower() == ".npy" or not labels_beside(scan):
            missing.append(path)
    number = len(paths) - len(missing)
    if number and missing:
        _log.warning(
            "%d of %d scans have labels; the first without: %s", number, len(paths), missing[0]
        )
    return number


@contextmanager
def leaving_out(advised: bool) -> Iterator[None]:
    """Adds to the error of a scan, if `advised`, how a training leaves such scans out."""
    try:
        yield
    except InputError as error:
        if not advised:
            raise
        raise InputError(
            f"{error} In training data.reading.on_bad_scan=skip leaves such scans out."
        ) from None
