"""What is known of scans to complete: all that was measured, or what a mask keeps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from r2flow.base import noise
from r2flow.base.errors import InputError, check
from r2flow.base.progress import track
from r2flow.data.partial import PartialScan
from r2flow.generators.base import Precision
from r2flow.lidar.known import Mask, Ray, share_in_sectors
from r2flow.lidar.labels import SEMANTIC_KITTI, LabelList
from r2flow.lidar.other_sensors import Partial, gaps_unknown
from r2flow.model.completion import Completed
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


@dataclass(frozen=True)
class Answered:
    """A scan, what was known of it, and its answers."""

    number: int
    scan: PartialScan
    known: Partial
    completed: Completed


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
            f"not (--checkpoint {DENSIFY}): complete them apart, or give one --checkpoint for all."
        )
    return True in kinds


@lru_cache(maxsize=16)  # read the scans of a small folder once
def measured_rays(scan: PartialScan, job: Job) -> Partial:
    """All that was measured of a scan, without the hidden channels; without ranges, only its labels
    are left.
    """
    measured = scan.read()
    if job.fill_gaps:
        measured = gaps_unknown(measured)
    image = measured.image.copy()
    if "label" in job.hide:
        image = image[:2]
    if "reflectance" in job.hide:
        image[1:2] = 0
    if "range" not in job.hide:
        return replace(measured, image=image if image[1:].any() else image[:1])
    image[:2] = 0
    check(image.any(), "without ranges a scan has no known ray: give one with labels.")
    return Partial(image, np.full_like(measured.state, Ray.UNKNOWN))


def known_rays(scan: PartialScan, job: Job, number: int) -> Partial:
    """Known rays of scan `number` that the job's mask keeps, with their points; the mask depends
    only on (seed, number).
    """
    partial = measured_rays(scan, job)
    if job.mask is None:
        return partial
    measured = partial.state != Ray.UNKNOWN
    kept = job.mask(measured, noise.generator(job.seed, "condition", number))
    for some, what in ((measured & kept, "nothing"), (measured & ~kept, "everything")):
        check(some.any(), f"{scan.name}: the mask keeps {what} that was measured; give another.")
    state = np.where(kept, partial.state, np.uint8(Ray.UNKNOWN))
    xyz = None if partial.xyz is None else partial.xyz * kept
    masked = replace(partial, image=partial.image * kept, state=state, xyz=xyz)
    points, place, row = partial.points, partial.place, partial.row
    if points is None or points.kept is None or place is None or row is None:
        return masked
    few = np.unique(place[state == Ray.RETURN])  # the points in known pixels
    reflectance = None if points.reflectance is None else points.reflectance[few]
    left = replace(points, xyz=points.xyz[few], reflectance=reflectance, kept=points.kept[few])
    return replace(masked, points=replace(left, ring=None), row=row[few], place=None)
