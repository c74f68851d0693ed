"""What is known of scans to complete: all that was measured, or what a mask keeps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from r2flow.base import noise
from r2flow.base.errors import InputError
from r2flow.base.progress import track
from r2flow.data.partial import PartialScan
from r2flow.generators.base import Precision
from r2flow.lidar.known import Mask, Ray, share_in_sectors
from r2flow.lidar.labels import SEMANTIC_KITTI, LabelList
from r2flow.lidar.other_sensors import Partial, gaps_unknown
from r2flow.lidar.scan_files import Points
from r2flow.model.shipped import DEFAULT, DENSIFY


@dataclass(frozen=True)
class Job:
    """Settings of completions."""

    num: int = 1  # answers per scan
    seed: int = 0
    mask: Mask | None = None  # measured rays to use; None: all
    fill_gaps: bool = False  # treat rays without a return as unmeasured
    hide: frozenset[str] = frozenset()  # channels that are drawn anew; range takes all returns
    batch_size: int = 1
    pictures: int = 8  # number of scans with a picture and a 3-D page
    precision: Precision = "32-true"
    label_ids: LabelList = SEMANTIC_KITTI  # of the labels of scans and answers
    max_error: float | None = None  # metres that error_68 of an added point may have


def lack_sectors(scans: Sequence[PartialScan], job: Job) -> bool:
    """Whether most unknown rays of each scan lie in sectors without known rays; ignores scans
    without unknown rays.

    Refuses a mixture of both kinds of scans.
    """
    kinds: dict[bool, str] = {}
    for number, scan in enumerate(track(scans, "looking at", "scans")):
        state = known_rays(scan, job, number).state
        if (state == Ray.UNKNOWN).any():
            kinds.setdefault(share_in_sectors(state) >= 0.5, scan.name)
    if len(kinds) > 1:
        raise InputError(
            f"{kinds[True]} lacks whole sectors (--checkpoint {DEFAULT}) and {kinds[False]} does "
            "not (--checkpoint "
            f"{DENSIFY}): complete them apart, or give one --checkpoint for all."
        )
    return True in kinds


@lru_cache(maxsize=16)  # read the scans of a small folder once
def measured_rays(scan: PartialScan, job: Job) -> Partial:
    """All that was measured of a scan."""
    given = scan.read()
    return _without(gaps_unknown(given) if job.fill_gaps else given, job.hide)


def known_rays(scan: PartialScan, job: Job, number: int) -> Partial:
    """Known rays of scan `number` that the job's mask keeps, with their points; the mask depends
    only on (seed, number).
    """
    given = measured_rays(scan, job)
    if job.mask is None:
        return given
    measured = given.state != Ray.UNKNOWN
    kept = job.mask(measured, noise.generator(job.seed, "condition", number))
    for some, what in ((measured & kept, "nothing"), (measured & ~kept, "everything")):
        if not some.any():
            raise InputError(f"{scan.name}: the mask keeps {what} that was measured; give another.")
    state = np.where(kept, given.state, np.uint8(Ray.UNKNOWN))
    xyz = None if given.xyz is None else given.xyz * kept
    masked = replace(given, image=given.image * kept, state=state, xyz=xyz)
    return masked if given.points is None else _with_points_of(masked)


def _with_points_of(given: Partial) -> Partial:
    """A partial scan whose points are those of its known pixels alone."""
    points = given.points
    assert points is not None
    assert points.kept is not None
    assert given.place is not None
    assert given.row is not None
    chosen = np.unique(given.place[given.state == Ray.RETURN])
    strength = points.reflectance
    few = Points(
        points.xyz[chosen],
        None if strength is None else strength[chosen],
        dropped=points.dropped,
        kept=points.kept[chosen],
        cloud=points.cloud,
    )
    return replace(given, points=few, row=given.row[chosen], place=None)


def _without(given: Partial, hidden: frozenset[str]) -> Partial:
    """A partial scan without some channels; without ranges, only its labels are left."""
    image = given.image.copy()
    if "label" in hidden:
        image = image[:2]
    if "reflectance" in hidden:
        image[1:2] = 0
    if "range" not in hidden:
        return replace(given, image=image if image[1:].any() else image[:1])
    image[:2] = 0
    if not image.any():
        raise InputError("without ranges a scan has no known ray: give one with labels.")
    return Partial(image, np.full_like(given.state, Ray.UNKNOWN))
