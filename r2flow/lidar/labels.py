"""Semantic labels of scans: SemanticKITTI's `.label` files and ids, PandaSet's, and the common
classes of labelled models.
"""

from pathlib import Path

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError
from r2flow.base.files import atomic_write, reading
from r2flow.lidar.scan_files import (
    LARGEST_FILE,
    TABLE_ENDINGS,
    Points,
    pandaset,
)

# SemanticKITTI's ids: name, and the colour in pictures (ground grey to violet, vehicles blue,
# people red, plants green, buildings and fences brown; moving objects as static ones).
CLASSES = {
    0: ("unlabeled", "#6b727c"),
    1: ("outlier", "#454b54"),
    10: ("car", "#3f8efc"),
    11: ("bicycle", "#7fd1ff"),
    13: ("bus", "#2a5bd7"),
    15: ("motorcycle", "#58b4e8"),
    16: ("on-rails", "#1b3a9e"),
    18: ("truck", "#5c7cfa"),
    20: ("other vehicle", "#8aa2ff"),
    30: ("person", "#ff4d4d"),
    31: ("bicyclist", "#ff8787"),
    32: ("motorcyclist", "#d6336c"),
    40: ("road", "#9a86c9"),
    44: ("parking", "#c3a6e8"),
    48: ("sidewalk", "#d9b8d9"),
    49: ("other ground", "#a07f8f"),
    50: ("building", "#d9a441"),
    51: ("fence", "#b5713c"),
    52: ("other structure", "#8f6a3a"),
    60: ("lane marking", "#f4ecff"),
    70: ("vegetation", "#37a046"),
    71: ("trunk", "#7a5a2f"),
    72: ("terrain", "#a8cf6a"),
    80: ("pole", "#ffe066"),
    81: ("traffic sign", "#ff922b"),
    99: ("other object", "#5fd3bc"),
    252: ("moving car", "#3f8efc"),
    253: ("moving bicyclist", "#ff8787"),
    254: ("moving person", "#ff4d4d"),
    255: ("moving motorcyclist", "#d6336c"),
    256: ("moving on-rails", "#1b3a9e"),
    257: ("moving bus", "#2a5bd7"),
    258: ("moving truck", "#5c7cfa"),
    259: ("moving other vehicle", "#8aa2ff"),
}

# Ids by SemanticKITTI's spelling of the names.
LABELS = {name.replace(" ", "-"): label for label, (name, _) in CLASSES.items()}

# The classes 1, 2, ... of a labelled model, which all data sets have. In files, the first id stands
# for its class; 0 is no label.
COMMON = {
    "road": (40, 44, 60),
    "sidewalk": (48,),
    "terrain and vegetation": (70, 72, 49),
    "building": (50, 51),
    "pole": (80, 71, 81),
    "vehicle": (10, 11, 13, 15, 16, 18, 20, 252, 256, 257, 258, 259),
    "person": (30, 31, 32, 253, 254, 255),
    "other": (99, 52),
}
_IDS = np.array([0, *(ids[0] for ids in COMMON.values())], np.uint16)
_COMMON = np.zeros(2**16, np.float32)
for _number, _members in enumerate(COMMON.values(), 1):
    _COMMON[list(_members)] = _number


def common_classes(ids: ndarray) -> ndarray:
    """The common class of SemanticKITTI's ids, float32; 0 for those that have none."""
    return _COMMON[np.asarray(ids).clip(0, 2**16 - 1)]


def semantic_ids(classes: ndarray) -> ndarray:
    """The SemanticKITTI id that stands for each common class, uint16."""
    return _IDS[classes.astype(np.uint8)]


def labels_beside(scan: str | Path) -> Path | None:
    """The label file of a scan, or None.

    It is `000000.label` next to the scan, or `../labels/000000.label` of `velodyne/000000.bin`; of
    PandaSet `../annotations/semseg/00.pkl.gz` of `lidar/00.pkl.gz`.
    """
    if str(scan).endswith(TABLE_ENDINGS):
        labels = pandaset.labels_of(Path(scan))
        return labels if labels.is_file() else None
    file = Path(scan).with_suffix(".label")
    folder = file.parent.resolve()
    files = [file]
    if folder.name == "velodyne" and not (folder / "manifest.json").exists():  # not r2flow's
        files.append(folder.parent / "labels" / file.name)
    # A broken link is taken: reading it raises.
    return next((path for path in files if path.exists() or path.is_symlink()), None)


def write_labels(folder: Path, name: str, classes: ndarray, probability: ndarray) -> None:
    """Write `NAME.label` of points' common classes, as SemanticKITTI's ids, and their probabilities
    as `NAME.probability.npz`.
    """
    with atomic_write(folder / f"{name}.probability.npz") as file:
        np.savez_compressed(file, probability=probability.astype(np.float16))
    with atomic_write(folder / f"{name}.label") as file:
        file.write(semantic_ids(classes).astype("<u4").tobytes())


def read_labels(path: Path, scan: str | Path, points: Points) -> ndarray:
    """The semantic id of each of a scan's points, (N,) uint16, without dropped rows.

    A `.label` file has a uint32 per row of the scan's file, class id in the low 16 bits, instance
    in the high. PandaSet's classes become SemanticKITTI's ids.

    Raises:
        InputError: The file has not one label a row.
    """
    size = 4 * (len(points.xyz) + points.dropped)
    with reading(path, LARGEST_FILE, "file of labels", least=0):
        if path.name.endswith(TABLE_ENDINGS):
            ids = pandaset.read_classes(path, Path(scan))
            return ids if points.kept is None else ids[points.kept]
        found = path.stat().st_size  # checked first: a file of the wrong size is not loaded
        if found != size:
            raise InputError(
                f"it holds {found} bytes, not {size}: a uint32 for each point of {scan}."
            )
        ids = np.fromfile(path, dtype="<u4").astype(np.uint16)  # the low 16 bits
    return ids if points.kept is None else ids[points.kept]
