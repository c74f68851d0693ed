"""Semantic labels of scans: `.label` files in SemanticKITTI's ids or those of another list,
PandaSet's, and the common classes of labelled models.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError, check, naming, quoted
from r2flow.base.files import atomic_write, parse_yaml, reading
from r2flow.lidar.scan_files import (
    LARGEST_FILE,
    TABLE_ENDINGS,
    Points,
    pandaset,
)

_LISTS = Path(__file__).with_name("label_lists")
# SemanticKITTI's ids: name, and the colour in pictures.
CLASSES: dict[int, tuple[str, str]] = {
    number: tuple(named)
    for number, named in parse_yaml((_LISTS / "semantic_kitti.yaml").read_text("utf-8")).items()
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
# Names and colours of these classes by the ids that stand for them.
STANDING = {ids[0]: (name, CLASSES[ids[0]][1]) for name, ids in COMMON.items()}
_IDS = np.array([0, *STANDING], np.uint16)
_COMMON = np.zeros(2**16, np.float32)
for _number, _members in enumerate(COMMON.values(), 1):
    _COMMON[list(_members)] = _number


def common_classes(ids: ndarray) -> ndarray:
    """The common class of SemanticKITTI's ids, float32; 0 for those that have none."""
    return _COMMON[np.asarray(ids).clip(0, 2**16 - 1)]


def semantic_ids(classes: ndarray) -> ndarray:
    """The SemanticKITTI id that stands for each common class, uint16."""
    return _IDS[classes.astype(np.uint8)]


@dataclass(frozen=True)
class LabelList:
    """The ids of a data set or a network, and the SemanticKITTI id that each is read as."""

    name: str
    ids: tuple[tuple[int, int], ...]

    @property
    def described(self) -> Any:
        """As plain values that `label_list` takes."""
        return self.name if self.name in _names() else dict(self.ids)

    def semantic(self, found: ndarray) -> ndarray:
        """SemanticKITTI's ids of ids of this list, uint16, of the same shape.

        Raises:
            InputError: Some are not in the list, so they are of another one.
        """
        seen, place, counts = np.unique(found, return_inverse=True, return_counts=True)
        known = dict(self.ids)
        shares = {int(i): n / found.size for i, n in zip(seen, counts, strict=True)}
        strange = sorted(shares.keys() - known.keys())
        if strange:
            frequent = sorted(shares, key=lambda number: -shares[number])[:8]
            told = ", ".join(f"{number} ({shares[number]:.1%})" for number in frequent)
            fitting = [n for n in _names() if shares.keys() <= dict(label_list(n).ids).keys()]
            named = " or ".join([*fitting, "a YAML file of lines such as `1: car`"])
            raise InputError(
                f"its labels are not of {self.name}, which has no {str(strange[:8])[1:-1]}; most "
                f"frequent: {told}. Name their list by --label-ids, in training "
                f"data.reading.label_ids: {named}."
            )
        read_as = np.array([known[number] for number in shares], np.uint16)
        return read_as[place].reshape(found.shape)

    def of_classes(self, classes: ndarray) -> ndarray:
        """The id of this list that stands for each common class, uint32: that of `semantic_ids`,
        else the first id of the class, else one without a class.
        """
        numbers: list[int] = []
        for common, standing in enumerate(_IDS):
            same = [number for number, id in self.ids if id == standing]
            of_class = [number for number, id in self.ids if _COMMON[id] == common]
            numbers.append([*same, *of_class, *numbers[:1], 0][0])
        return np.array(numbers, np.uint32)[classes.astype(np.uint8)]


def _names() -> list[str]:
    return sorted(path.stem for path in _LISTS.glob("*.yaml"))


def label_list(source: "str | Mapping[Any, Any] | LabelList") -> LabelList:
    """A list of ids: a name in `label_lists`, a YAML file, or the map of ids itself, to
    SemanticKITTI's names or ids. In a file the map may be that of the key `labels`.

    Raises:
        InputError: There is no such list, or it maps to no class of SemanticKITTI.
    """
    if isinstance(source, LabelList):
        return source
    entries = source
    name = "the list given"
    if isinstance(source, str):
        name = source
        file = Path(source).expanduser()
        if file.suffix.lower() not in (".yaml", ".yml"):
            known = ", ".join(_names())
            check(source in _names(), f"no list of ids named {quoted(source)}; known: {known}.")
            file = _LISTS / f"{source}.yaml"
        with reading(file, 1 << 20, "list of ids"):
            entries = parse_yaml(file.read_text(encoding="utf-8"))
    with naming(name):
        lines = entries.get("labels", entries) if isinstance(entries, Mapping) else None
        if not lines or not isinstance(lines, Mapping):
            raise InputError("it is not a list of ids: give lines such as `1: car`.")
        for number in lines:
            check(str(number).isdecimal(), f"an id is a whole number; found {quoted(number)}.")
        ids = [(int(number), _semantic_id(named)) for number, named in lines.items()]
    return LabelList(name, tuple(ids))


def _semantic_id(named: Any) -> int:
    """SemanticKITTI's id of a name of its list, or of that id itself."""
    name = named[0] if isinstance(named, list) else named
    number: Any = LABELS.get(str(name).replace(" ", "-"), name)
    known = ", ".join(LABELS)
    check(number in CLASSES, f"{quoted(name)} is no class of SemanticKITTI; known: {known}.")
    return int(number)


SEMANTIC_KITTI = label_list("semantic_kitti")


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


def write_labels(
    folder: Path,
    name: str,
    classes: ndarray,
    probability: ndarray,
    *,
    ids: LabelList = SEMANTIC_KITTI,
) -> None:
    """Write `NAME.label` of points' common classes, as ids of a list, and their probabilities as
    `NAME.probability.npz`.
    """
    with atomic_write(folder / f"{name}.probability.npz") as file:
        np.savez_compressed(file, probability=probability.astype(np.float16))
    with atomic_write(folder / f"{name}.label") as file:
        file.write(ids.of_classes(classes).astype("<u4").tobytes())


def read_labels(
    path: Path, scan: str | Path, points: Points, ids: LabelList | None = SEMANTIC_KITTI
) -> ndarray:
    """The SemanticKITTI id of each of a scan's points, (N,) uint16, without dropped rows.

    A `.label` file has a uint32 per row of the scan's file, class id in the low 16 bits, instance
    in the high. `ids` is the list of these ids; None: they are returned as they are.

    Raises:
        InputError: The file has not one label a row, or ids of another list.
    """
    size = 4 * (len(points.xyz) + points.dropped)
    with reading(path, LARGEST_FILE, "file of labels", least=0):
        if path.name.endswith(TABLE_ENDINGS):
            found = label_list("pandaset").semantic(pandaset.read_classes(path, Path(scan)))
            return found if points.kept is None else found[points.kept]
        bytes = path.stat().st_size  # checked first: a file of the wrong size is not loaded
        check(
            bytes == size, f"it holds {bytes} bytes, not {size}: a uint32 for each point of {scan}."
        )
        found = np.fromfile(path, dtype="<u4").astype(np.uint16)  # the low 16 bits
        found = found if ids is None else ids.semantic(found)
    return found if points.kept is None else found[points.kept]
