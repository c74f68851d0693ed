"""Reading of scan files and range images as images of a sensor."""

import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from r2flow.base.errors import InputError, naming, warn_odd
from r2flow.lidar.estimation import FULL_REFLECTANCE, OUTLIERS, SURE, full_reflectance
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
    read_points,
    read_range_image,
)
from r2flow.lidar.sensors import Sensor
from r2flow.store import manifest_of

log = logging.getLogger(__name__)

AUTO = "auto"
FAINT = 0.1  # of full reflectance: below it the scale is probably wrong
DARKEST = 0.01  # likewise of the median; that of bytes is 0.03 or more
DIVIDED = (
    "reflectance is divided by %g; --reflectance-scale (of r2flow.read reflectance_scale) "
    "names another value"
)
DARK = (
    "reflectance stays below a tenth of full reflectance, or half of it below a hundredth: the "
    "estimate of full reflectance may be wrong; give its value as --reflectance-scale, in training "
    "as data.reading.reflectance_scale, in a sensor's file as reflectance_scale"
)


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

    def described(self) -> dict[str, Any]:
        """All fields as plain values, for manifests."""
        values = {
            **vars(self),
            "sensor": self.sensor.described(),
            "label_ids": self.label_ids.described,
        }
        return json.loads(json.dumps(values))  # turns tuples into lists

    @classmethod
    def of(cls, described: Mapping[str, Any]) -> "Reading":
        """The reading of a manifest; missing fields have their defaults."""
        reading = cls(**{**described, "sensor": Sensor(**described["sensor"])})
        return replace(reading, columns=reading.columns and tuple(reading.columns))

    @classmethod
    def stored(cls, folder: str | Path) -> "Reading | None":
        """The reading in the manifest of scans that r2flow wrote; None for other scans."""
        described = manifest_of(folder).get("recipe", {}).get("reading")
        return described and cls.of(described)


def read_projected(
    path: str | Path, reading: Reading
) -> tuple[np.ndarray, Points, np.ndarray, np.ndarray]:
    """A file of points as an image, (2 or 1, H, W), and all its points.

    Also the pixels that have a point, h W + w, (M,), and the indices of these points, (M,).
    """
    sensor = reading.sensor
    try:
        points = read_points(path, reading.columns)
        if reading.projection == "unfolding":
            points = points.with_lost_rays()
        scaled = []
        if reading.reflectance:
            scaled = [scaled_reflectance(path, points, reading.reflectance_scale)]
        with naming(path):
            pixels, chosen, r = project_indices(
                points.xyz, sensor, reading.projection, reading.convention, points.ring
            )
        if not r.any():
            raise nothing_in_view(path, points, sensor)
        image = scatter(sensor, pixels, [r, *(channel[chosen] for channel in scaled)])
    except NoPointsError:
        if reading.on_bad_scan != "empty":
            raise
        points = Points(np.zeros((0, 3), np.float32))
        pixels = chosen = np.zeros(0, np.int64)
        image = np.zeros((1 + bool(reading.reflectance), *sensor.shape), np.float32)
    return image, points, pixels, chosen


def nothing_in_view(path: str | Path, points: Points, sensor: Sensor) -> NoPointsError:
    """The error for a scan without a return in the sensor's view."""
    r = np.linalg.norm(points.xyz, axis=1)
    return NoPointsError(
        f"{path}: none of its {len(r)} points lies within "
        f"{sensor.min_range:g}-{sensor.max_range:g} m and the "
        f"view of sensor '{sensor.name}' (ranges found: {r.min():.3g}-{r.max():.3g} m). "
        "Are its units metres and its sensor the configured one?"
    )


def read_labelled_scan(
    path: Path, file: Path, reading: Reading, ids: LabelList | None = SEMANTIC_KITTI
) -> tuple[np.ndarray, np.ndarray]:
    """The image of a scan, and from its label file each pixel's semantic id, (H, W) uint16, 0 for
    no return; `ids` as in `read_labels`.
    """
    image, points, pixels, chosen = read_projected(path, reading)
    labels = read_labels(file, path, points, ids)[chosen]
    return image, scatter(reading.sensor, pixels, [labels])[0].astype(np.uint16)


def _with_labels(path: Path, reading: Reading) -> np.ndarray:
    """The image of a scan with the common class of each ray as its last channel, 0 without a file
    of labels.
    """
    file = labels_beside(path)
    if file is None:
        return _unlabelled(read_projected(path, reading)[0])
    image, ids = read_labelled_scan(path, file, reading, reading.label_ids)
    return np.concatenate([image, common_classes(ids)[None]])


def _unlabelled(image: np.ndarray) -> np.ndarray:
    return np.concatenate([image, np.zeros_like(image[:1])])


def labelled(paths: Sequence[str | Path]) -> int:
    """The number of scan files with labels; warns of those without, if some have them."""
    missing = [path for path in paths if not _has_labels(points_beside(Path(path)))]
    number = len(paths) - len(missing)
    if number and missing:
        log.warning(
            "%d of %d scans have labels; the first without: %s", number, len(paths), missing[0]
        )
    return number


def _has_labels(path: Path) -> bool:
    return bool(labels_beside(path)) and path.suffix.lower() != ".npy"


def _no_reflectance(path: str | Path) -> InputError:
    return InputError(
        f"{path} has no reflectance, and other scans, a metric or the model need it. Give scans "
        "with it, metrics of "
        "range or a model of range alone (in training encoding.reflectance=false without a "
        "stage.parent that has it)."
    )


def estimated_scale(path: str | Path, scans: Iterable[Points]) -> float:
    """The largest estimate of full reflectance of scans, 1 without any; warns of a value that
    others may exceed.
    """
    scale = max((full_reflectance([points]) or 0.0 for points in scans), default=0.0) or 1.0
    if scale not in SURE:
        warn_odd(Path(path), DIVIDED % scale)
    return scale


def is_dark(reflectance: np.ndarray, scale: float) -> bool:
    """Whether values above 0 are so far below full reflectance that it is probably another one."""
    return bool(reflectance.max() < FAINT * scale or np.median(reflectance) < DARKEST * scale)


def scaled_reflectance(
    path: str | Path, points: Points, scale: float | None, strict: bool = True
) -> np.ndarray:
    """The reflectance of points in [0, 1], by `reflectance_and_scale`."""
    return reflectance_and_scale(path, points, scale, strict)[0]


def reflectance_and_scale(
    path: str | Path, points: Points, scale: float | None, strict: bool = True
) -> tuple[np.ndarray, float]:
    """The reflectance of points, scaled to [0, 1], and the scale; None estimates it. Unless
    `strict`, all beyond is clipped.
    """
    if points.reflectance is None:
        raise _no_reflectance(path)
    path = Path(path)
    stored = points.reflectance
    highest = float(stored.max(initial=0))
    seen = stored[stored > 0]
    scale = estimated_scale(path, [points]) if scale is None else scale
    if len(seen):
        fractions = np.mean(seen > 1) <= OUTLIERS and (seen % 1).any()
        if scale in FULL_REFLECTANCE[1:] and fractions:
            kind = f"reflectance already lies in 0 to 1, and is not divided by {scale:g}"
            warn_odd(path, kind)
            scale = 1.0
        if is_dark(seen, scale):
            warn_odd(path, DARK)
    if strict and stored.min(initial=0) < 0:
        raise InputError(
            f"{path}: reflectance must not be negative, found {stored.min():g}; correct the file."
        )
    beyond = int(np.count_nonzero(stored > 1.001 * scale))
    if strict and beyond > OUTLIERS * len(stored):
        full = max(full_reflectance([points]) or 0, 255)
        raise InputError(
            f"{path}: reflectance must lie in [0, {scale:g}], found up to {highest:g}. "
            f"Give the value of full reflectance, often {full:g}: "
            f"data.reading.reflectance_scale={full:g}, that of "
            f"its part of data.parts, or --reflectance-scale {full:g}."
        )
    if beyond:
        warn_odd(path, f"reflectance beyond {scale:g} is clipped", beyond)
    return (stored / np.float32(scale)).clip(0, 1), scale


def read_image(path: Path, reading: Reading) -> np.ndarray:
    """Read a scan file or a range image as an image, (2 or 1, H, W), and with labels a class more.

    Labels are those of points: of a range image, of the file of points next to it.
    """
    channels = 1 + bool(reading.reflectance)
    if reading.labels:
        path = points_beside(path)
    image = read_range_image(path)
    if image is None:
        return _with_labels(path, reading) if reading.labels else read_projected(path, reading)[0]
    if image.shape[1:] != reading.sensor.shape:
        size = "x".join(map(str, image.shape[1:]))
        raise InputError(
            f"{path} is a range image of {size}, sensor {reading.sensor}; give --size {size}, or "
            "its points (.bin, .ply, .pcd), which take any size."
        )
    if len(image) < channels:
        raise _no_reflectance(path)
    image = image[:channels]
    if not reading.within_limits:
        return _unlabelled(image) if reading.labels else image
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
    return _unlabelled(image) if reading.labels else image


def read_points_image(path: Path, reading: Reading) -> tuple[np.ndarray, np.ndarray]:
    """Read points as an image, (2 or 1, H, W), and its pixels' points in metres, (3, H, W) float32,
    0 for no return.
    """
    image, points, pixels, chosen = read_projected(path, reading)
    return image, scatter(reading.sensor, pixels, points.xyz[chosen].T)


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


def lacks_reflectance(
    paths: Iterable[str | Path], on_bad_scan: str = "error", columns: Sequence[str] | None = None
) -> str | None:
    """Reason why scan files count as files without reflectance; None if they have reflectance.

    Training, metrics and pictures share this rule: the first scan with a return decides, and
    reflectance of only 0 counts as missing, because a KITTI .bin always has a column for it.
    Unreadable scans are skipped with `on_bad_scan="skip"`, scans without a point also with "empty".
    """
    for path in paths:
        try:
            image = read_range_image(path)
            if image is None:
                reflectance = read_points(path, columns).reflectance
            else:
                reflectance = image[1][image[0] > 0] if len(image) > 1 else None
        except InputError as error:
            usable = on_bad_scan == "empty" and isinstance(error, NoPointsError)
            if on_bad_scan != "skip" and not usable:
                raise
            continue
        if reflectance is None:
            return f"{path} has no reflectance"
        if reflectance.size:
            return None if reflectance.any() else f"the reflectance in {path} is 0 throughout"
    return "no scan has a return"
