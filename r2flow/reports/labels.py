"""Labels of scans against true ones: `r2flow evaluate --metrics miou`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree
from scipy.stats import sem
from scipy.stats import t as student

from r2flow.base.errors import InputError, check
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
from r2flow.reports.tables import Table

_SAME = 0.01  # metres between a true point and the labelled one
_BINS = 10  # of probability


def label_tables(real: str, generated: str, ids: Sequence[str] = ()) -> list[Table]:
    """IoU of each class, and of scans with probabilities how often these are right.

    Scans of the same name are compared at the points that both have. `ids` are lists of label ids:
    one of both, or those of the real and of the generated scans; r2flow's answers know theirs.

    Raises:
        InputError: no scan of the same name with labels.
    """
    sides = describe(real), describe(generated)
    lists = [_ids_of(sides[0], ids[:1]), _ids_of(sides[1], ids[-1:])]
    truth, found = map(_labelled, sides)
    pairs = [*zip(truth.values(), found.values(), strict=False)]
    if len(truth) != 1 or len(found) != 1:
        pairs = [(truth[name], found[name]) for name in truth if name in found]
    if not pairs:
        raise InputError(
            f"{real} and {generated} have no labelled scan of the same name; labels lie beside a "
            "scan, as 000000.label."
        )
    counts = []
    probabilities = []  # and whether they were right
    for one, other in track(pairs, "comparing", "scans"):
        true, labels, probability = _matched(one, other, lists)
        counts.append(confusion(true, labels))
        check(counts[-1].any(), f"{one} and {other} share no point with a label.")
        if probability is not None:
            probabilities.append(np.stack([probability, labels == true])[:, true > 0])
    total = np.sum(counts, axis=0)
    points = int(total.sum())
    classes = zip(COMMON, class_ious(total), total[1:].sum(1), strict=True)
    rows = [(name, iou, int(count)) for name, iou, count in classes]
    rows += [("mean", mean_iou(total), points), ("right", total.trace() / points, points)]
    if len(counts) > 1:
        means = [mean_iou(one) for one in counts]
        half = student.ppf(0.975, len(means) - 1) * sem(means)
        rows.append((f"mean of {len(means)} scans, +-{half:.3f}", float(np.mean(means)), points))
    tables = [Table(rows, ("class", "IoU", "points"), f"labels of {generated}")]
    if probabilities:
        tables.append(_calibration(*np.concatenate(probabilities, axis=1)))
    return tables


def _calibration(probability: ndarray, right: ndarray) -> Table:
    """How many of the labels are right, by tenths of their probability."""
    part = (probability * _BINS).astype(int).clip(0, _BINS - 1)
    count = np.bincount(part, minlength=_BINS)
    said, true = (np.bincount(part, values, _BINS) for values in (probability, right))
    rows = [(said[i] / count[i], true[i] / count[i], int(count[i])) for i in np.flatnonzero(count)]
    return Table(rows, ("said", "right", "points"), "probability that a label is right")


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
    distance, number = cKDTree(others).query(xyz, distance_upper_bound=_SAME)
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
