"""Labels of scans against true ones: `r2flow evaluate --metrics miou`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree
from scipy.stats import t as student

from r2flow.base.errors import InputError
from r2flow.base.progress import track
from r2flow.data.described import Described, describe
from r2flow.lidar.labels import (
    COMMON,
    SEMANTIC_KITTI,
    LabelList,
    common_classes,
    label_list,
    labels_beside,
    read_labels,
)
from r2flow.lidar.scan_files import points_beside, read_points, scan_ending
from r2flow.metrics.labels import class_ious, confusion, mean_iou
from r2flow.reports.tables import Row

SAME = 0.01  # metres between a true point and the labelled one
BINS = 10  # of probability


def label_rows(real: str, generated: str, ids: Sequence[str] = ()) -> tuple[list[Row], list[Row]]:
    """Rows of IoU, a row a class, and of calibration, a row a tenth of probability.

    Scans of the same name are compared at the points that both have. `ids` are lists of label ids:
    one of both, or those of the real and of the generated scans; r2flow's answers know theirs.

    Raises:
        InputError: no scan of the same name with labels.
    """
    sets = describe(real), describe(generated)
    lists = [_ids_of(sets[0], ids[:1]), _ids_of(sets[1], ids[-1:])]
    truth, found = map(_labelled, sets)
    pairs = [*zip(truth.values(), found.values(), strict=False)]
    if len(truth) != 1 or len(found) != 1:
        pairs = [(truth[name], found[name]) for name in truth if name in found]
    if not pairs:
        raise InputError(
            f"{real} and {generated} have no labelled scan of the same name; labels lie beside a "
            "scan, as 000000.label."
        )
    total = np.zeros((len(COMMON) + 1, len(COMMON) + 1), np.int64)
    sure = np.zeros((3, BINS))  # points, the sum of their probabilities, and the right ones
    means = []
    for one, other in track(pairs, "comparing", "scans"):
        true, labels, probability = _matched(one, other, lists)
        counts = confusion(true, labels)
        if not counts.any():
            raise InputError(f"{one} and {other} share no point with a label.")
        total += counts
        means.append(mean_iou(counts))
        if probability is not None:
            p = probability[true > 0]
            part = (p * BINS).astype(int).clip(0, BINS - 1)
            right = (labels == true)[true > 0]
            sure += [np.bincount(part, each, BINS) for each in (np.ones(len(p)), p, right)]
    rows: list[Row] = [
        {"class": name, "iou": iou, "points": int(count)}
        for name, iou, count in zip(COMMON, class_ious(total), total[1:].sum(1), strict=True)
    ]
    rows.append({"class": "mean", "iou": mean_iou(total), "points": int(total.sum())})
    rows.append({"class": "right", "iou": total.trace() / total.sum(), "points": int(total.sum())})
    if len(means) > 1:
        half = student.ppf(0.975, len(means) - 1) * np.std(means, ddof=1) / len(means) ** 0.5
        text = f"mean of {len(means)} scans, +-{half:.3f}"
        rows.append({"class": text, "iou": float(np.mean(means)), "points": int(total.sum())})
    calibration = [
        {"said": mean / count, "right": right / count, "points": int(count)}
        for count, mean, right in sure.T
        if count
    ]
    return rows, calibration


def _ids_of(scans: Described, ids: Sequence[str]) -> LabelList:
    """The list of the label ids of a name's scans."""
    stored = scans.stored
    return stored.label_ids if stored else label_list(next(iter(ids), SEMANTIC_KITTI))


def _labelled(scans: Described) -> dict[str, Path]:
    """The scans of a name that have labels, by their path without ending."""
    files = {}
    for path in map(points_beside, map(Path, scans.paths)):
        if labels_beside(path):
            name = str(path).removesuffix(scan_ending(path.name) or path.suffix)
            files[str(Path(name).relative_to(scans.options.folder))] = path
    return files


def _matched(
    truth: Path, found: Path, lists: Sequence[LabelList]
) -> tuple[ndarray, ndarray, ndarray | None]:
    """True and found classes, and the found ones' probabilities, of the points of both."""
    xyz, true, _ = _points(truth, lists[0])
    others, labels, probability = _points(found, lists[1])
    distance, number = cKDTree(others).query(xyz, distance_upper_bound=SAME)
    both = np.isfinite(distance)
    number = number[both]
    return true[both], labels[number], None if probability is None else probability[number]


def _points(path: Path, ids: LabelList) -> tuple[ndarray, ndarray, ndarray | None]:
    file = labels_beside(path)
    assert file is not None
    points = read_points(path)
    classes = common_classes(read_labels(file, path, points, ids))
    saved = file.with_suffix(".probability.npz")
    if not saved.is_file():
        return points.xyz, classes, None
    with np.load(saved) as stored:
        return points.xyz, classes, stored["probability"].astype(np.float64)
