"""Label files: the class of each pixel's return; damaged and other files are refused."""

from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.data.reading import Reading, read_labelled_scan
from r2flow.lidar.labels import LABELS, labels_beside, read_labels
from r2flow.lidar.scan_files import read_points, write_points
from r2flow.lidar.sensors import SENSORS
from tests.conftest import refused

SENSOR = SENSORS["hdl64e"].resized(8, 16)
COUNT = 200
RNG = np.random.default_rng(3)
XYZ = RNG.uniform([5, -30, -2], [40, 30, 0], (COUNT, 3)).astype(np.float32)
IDS = RNG.choice([0, 10, 40, 70, 258], COUNT).astype(np.uint32)
INSTANCES = np.where(IDS == 10, RNG.integers(1, 300, COUNT), 0).astype(np.uint32)
WHOLE = (IDS | INSTANCES << 16).astype("<u4").tobytes()


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    path = tmp_path / "sequences/00/velodyne/000000.bin"
    path.parent.mkdir(parents=True)
    write_points(path, XYZ, np.full(COUNT, 0.5, np.float32))
    return path


@pytest.fixture
def label(scan: Path) -> Path:
    path = scan.parent.parent / "labels/000000.label"
    path.parent.mkdir()
    path.write_bytes(WHOLE)
    return path


def test_label_files_are_found_in_the_labels_folder_and_beside_the_scan(scan: Path, tmp_path: Path):
    assert labels_beside(scan) is None
    beside = scan.with_name("000000.label")
    beside.symlink_to("gone")  # a link to nothing was meant to be a file
    assert labels_beside(scan) == beside
    with refused(beside):
        read_labels(beside, scan, read_points(scan))
    beside.unlink()
    beside.write_bytes(WHOLE)
    assert labels_beside(scan) == beside
    np.testing.assert_array_equal(read_labels(beside, scan, read_points(scan)), IDS)


def test_labels_are_not_those_of_other_scans_next_to_the_folder(
    scan: Path, label: Path, tmp_path: Path
):
    assert labels_beside(scan) == label
    assert labels_beside(scan.parent.with_name("thinned") / scan.name) is None
    (linked := tmp_path / "scans").symlink_to(scan.parent)
    assert labels_beside(linked / scan.name).samefile(label)
    (scan.parent / "manifest.json").touch()  # completed scans are not the labelled ones
    assert labels_beside(scan) is None
    scan.with_suffix(".label").touch()
    assert labels_beside(scan) == scan.with_suffix(".label")


def test_each_pixel_has_the_label_of_its_nearest_return(scan: Path, label: Path):
    ranges, ids = np.array([20, 10, 30, 10, 20, 90, 0.5]), np.array([40, 70, 50, 10, 40, 50, 70])
    e, a = SENSOR.rays().numpy()[
        :, 3, [5, 5, 5, 9, 9, 2, 9]
    ]  # three returns of a pixel, two of another in range
    write_points(
        scan,
        (ranges * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])).T,
        np.zeros(7),
    )
    label.write_bytes(ids.astype("<u4").tobytes())
    image, labels = read_labelled_scan(scan, label, Reading(SENSOR, reflectance=True))
    assert labels.dtype == np.uint16
    assert (labels[3, 5], labels[3, 9], np.count_nonzero(labels)) == (70, 10, 2)
    assert np.array_equal(labels > 0, image[0] > 0)


def test_labels_of_dropped_rows_are_dropped(scan: Path, label: Path):
    rows = np.fromfile(scan, "<f4").reshape(-1, 4)
    rows[17, 0], rows[90, 2] = np.nan, 1e30
    rows.tofile(scan)
    np.testing.assert_array_equal(
        read_labels(label, scan, read_points(scan)), np.delete(IDS, [17, 90])
    )


def test_a_cut_or_a_longer_file_is_refused(scan: Path, label: Path):
    points = read_points(scan)
    for length in [
        *range(0, len(WHOLE), 7),
        *range(788, 800),
        len(WHOLE) + 1,
        len(WHOLE) + 4,
        2 * len(WHOLE),
    ]:
        label.write_bytes((WHOLE * 2)[:length])
        with pytest.raises(InputError, match=f"holds {length} bytes, not 800"):
            read_labels(label, scan, points)


def test_ids_are_those_of_semantickitti():
    ids = {
        "unlabeled": 0,
        "car": 10,
        "other-vehicle": 20,
        "lane-marking": 60,
        "other-object": 99,
        "moving-truck": 258,
    }
    assert {name: LABELS[name] for name in ids} == ids
