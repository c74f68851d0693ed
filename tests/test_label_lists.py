"""Labels of other lists of ids than SemanticKITTI's, and of some scans alone."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.lidar.labels import (
    CLASSES,
    COMMON,
    LABELS,
    common_classes,
    label_list,
    read_labels,
    write_labels,
)
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import read_points, write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator import simulate

SENSOR = SENSORS["hdl64e"].resized(16, 64)
# The classes that each list is read as, by hand: road, car, building, person, vegetation, pole.
NAMES = ("road", "car", "building", "person", "vegetation", "pole")
KNOWN = {
    "semantic_kitti": (40, 10, 50, 30, 70, 80),
    "semantic_kitti_learning": (9, 1, 13, 6, 15, 18),
    "nuscenes_lidarseg": (24, 17, 28, 2, 30, None),
    "semantic_poss": (22, 7, 15, 4, 9, 13),
    "rellis_3d": (10, None, 12, 17, 4, 5),
    "pandaset": (7, 13, 41, 30, 5, None),
}


def write_scan(folder: Path, name: str, ids: dict[int, int] | None = None) -> np.ndarray:
    """Write a simulated scan, and labels by a map from SemanticKITTI's ids; returns these."""
    scan = simulate(SENSOR, 0, 0)
    image = np.stack([scan.image[0], scan.labels.astype(np.float32)])
    xyz, labels = image_to_points(image, SENSOR.rays())
    folder.mkdir(parents=True, exist_ok=True)
    write_points(folder / f"{name}.bin", xyz, np.full(len(xyz), 0.5))
    semantic = labels.ravel().astype(int)
    if ids is not None:
        np.array([ids.get(i, i) for i in semantic], "<u4").tofile(folder / f"{name}.label")
    return semantic


@pytest.mark.parametrize("name", KNOWN)
def test_each_list_is_read_as_the_classes_that_it_names(name):
    ids = label_list(name)
    for known, number in zip(NAMES, KNOWN[name], strict=True):
        if number is not None:
            assert ids.semantic(np.array([[number]])).item() == LABELS[known]
    unknown = max(dict(ids.ids)) + 1
    with pytest.raises(InputError, match=rf"no {unknown};.* {unknown} \(50\.0%\)"):
        ids.semantic(np.array([ids.ids[0][0], unknown]))


@pytest.mark.parametrize("name", KNOWN)
def test_the_ids_written_are_read_as_the_class_they_were_written_for(tmp_path, name):
    ids = label_list(name)
    having = [c for c in range(len(COMMON) + 1) if c in common_classes(ids.semantic(np.array(
        [number for number, _ in ids.ids])))]  # fmt: skip
    classes = np.array(having)
    write_labels(tmp_path, "0", classes, np.ones(len(classes)), ids=ids)
    written = np.fromfile(tmp_path / "0.label", "<u4")
    np.testing.assert_array_equal(common_classes(ids.semantic(written)), classes)


def test_labels_of_another_list_are_refused_with_their_shares(tmp_path):
    semantic = write_scan(tmp_path, "0", {40: 9, 50: 13, 10: 1})
    path = tmp_path / "0.bin"
    share = f"9 ({(semantic == 40).mean():.1%})"
    with pytest.raises(InputError) as error:
        read_labels(path.with_suffix(".label"), path, read_points(path))
    assert share in str(error.value)
    assert "--label-ids" in str(error.value)


@pytest.mark.parametrize("nested", [False, True])
def test_a_file_of_ids_reads_a_list_of_the_user(tmp_path, nested):
    semantic = write_scan(tmp_path, "0", {40: 1007, 50: 3, 10: 5})
    lines = {1007: "road", 3: "building", 5: 10}
    lines |= {number: number for number in CLASSES if number not in lines}
    text = "".join(f"  {number}: {named}\n" for number, named in lines.items())
    file = tmp_path / "mine.yaml"
    file.write_text(f"labels:\n{text}" if nested else text.replace("  ", ""))
    path = tmp_path / "0.bin"
    found = read_labels(path.with_suffix(".label"), path, read_points(path), label_list(str(file)))
    np.testing.assert_array_equal(found, semantic)
    source = open_scans(tmp_path, Reading(SENSOR, labels=True, label_ids=str(file))).source
    assert set(np.unique(source[0][2])) <= {0, *np.unique(common_classes(semantic))}
    again = Reading.of(source.reading.described())  # the ids themselves are in a manifest
    assert dict(again.label_ids.ids) == dict(label_list(str(file)).ids)
    # another map of the same file: other images
    file.write_text(text.replace("road", "sidewalk").replace("  ", ""))
    other = open_scans(tmp_path, Reading(SENSOR, labels=True, label_ids=str(file))).source
    assert other.contents != source.contents


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1: spaceship", "'spaceship' is no class of SemanticKITTI"),
        ("car: 1", "an id is a whole number; found 'car'"),
        ("[1, 2]", "not a list of ids"),
        ("a: &a {1: car}\nlabels: *a", "aliases"),
        ("1: car\n9: road\n1: building", "it has the key '1' 2 times"),
    ],
)
def test_a_file_of_ids_that_is_none_is_refused(tmp_path, text, said):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=said):
        label_list(str(file))
    with pytest.raises(InputError, match="no list of ids named 'kitti'; known: .*rellis_3d"):
        label_list("kitti")


def test_the_verbs_take_the_list_of_ids(r2flow: Callable, tmp_path: Path):
    learning = {number: own for own, number in label_list("semantic_kitti_learning").ids}
    scan = simulate(SENSOR, 0, 0)
    others = {int(i): learning.get(int(i), 19) for i in np.unique(scan.labels)}
    write_scan(tmp_path / "true", "0", {})
    write_scan(tmp_path / "found", "0", others)
    miou = ("evaluate", tmp_path / "true", tmp_path / "found", "--metrics", "miou")
    assert "has no" in r2flow(*miou).refusal
    done = r2flow(*miou, "--label-ids", "semantic_kitti,semantic_kitti_learning")
    assert done.returncode == 0, done.stderr
    # parking and lane markings are not among the 0..19 as such
    assert float(done.stdout.split("right")[1].split()[0]) > 0.9
    prepared = ("prepare", tmp_path / "found", "--out", tmp_path / "p", "--size", "16x64")
    assert "has no" in r2flow(*prepared).refusal
    done = r2flow(*prepared, "--label-ids", "semantic_kitti_learning")
    assert done.returncode == 0, done.stderr
    assert ", labels" in done.stdout


def test_labels_stay_where_one_scan_has_none(r2flow: Callable, tmp_path: Path):
    folder = tmp_path / "sequences/00/velodyne"
    semantic = write_scan(folder, "000000", {})
    write_scan(folder, "000001")
    write_scan(folder, "000002", {})
    labels = tmp_path / "sequences/00/labels"
    labels.mkdir()
    for name in ("000000", "000002"):
        (folder / f"{name}.label").rename(labels / f"{name}.label")
    out = tmp_path / "p"
    done = r2flow("prepare", f"odometry:{tmp_path}", "--out", out, "--size", "16x64")
    assert done.returncode == 0, done.stderr
    assert "2 of 3 scans have labels" in done.stderr
    assert "000001.bin" in done.stderr
    source = open_scans(out, Reading(SENSOR, reflectance=True, labels=True, projection="spherical",
                                     within_limits=True)).source  # fmt: skip
    assert source[0][2].any()
    assert not source[1][2].any()
    np.testing.assert_array_equal(source[2][2], source[0][2])
    assert set(np.unique(source[0][2])) <= {0, *np.unique(common_classes(semantic))}
