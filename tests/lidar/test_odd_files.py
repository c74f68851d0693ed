"""Files that are not what their name says, and advice that leads further."""

import numpy as np
import pytest

from r2flow.base.errors import InputError, _warned
from r2flow.lidar.bags import read_bag
from r2flow.lidar.scan_files import NoPointsError, points_beside, read_points, read_range_image
from r2flow.model.tensor_files import read_checkpoint, read_tensors


def turn(points: int = 6000) -> np.ndarray:
    """Six columns, a turn of 16 beams: x, y, z, intensity, beam, time."""
    a = np.linspace(0, 2 * np.pi, points, endpoint=False)
    e = np.radians(np.resize(np.arange(-15, 16, 2), points))
    d = 8 + 3 * np.sin(3 * a)
    draws = np.random.default_rng(0)
    xyz = [d * np.cos(a) * np.cos(e), d * np.sin(a) * np.cos(e), d * np.sin(e)]
    return np.stack([*xyz, draws.random(points), np.resize(range(16), points), a / 60], 1)


@pytest.mark.parametrize("kind", ["float16", "float64"])
@pytest.mark.parametrize("width", [3, 4, 5, 6])
def test_rows_of_other_floats_are_named_as_what_they_are(tmp_path, kind, width):
    turn(5999)[:, :width].astype(kind).tofile(tmp_path / "scan.bin")
    with pytest.raises(InputError, match=f"rows of {width} {kind}, not float32"):
        read_points(tmp_path / "scan.bin")


@pytest.mark.parametrize("width", [3, 5, 6, 7])
def test_rows_of_float32_keep_their_advice(tmp_path, width):
    rows = np.concatenate([turn(), turn()[:, 3:4]], axis=1)[:, :width]
    rows.astype("f4").tofile(tmp_path / "scan.bin")
    with pytest.raises(InputError, match=f"rows of {width} float32, not 4"):
        read_points(tmp_path / "scan.bin")
    shuffled = np.random.default_rng(0).permutation(turn()[:, :4])
    shuffled.astype("f4").tofile(tmp_path / "scan.bin")
    assert len(read_points(tmp_path / "scan.bin").xyz) == len(shuffled)


@pytest.mark.parametrize("value", [-1.0, -9999.0, 1e6, 65535.0, -0.5])
@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
def test_one_value_alone_is_no_return_at_any_share(tmp_path, value, share):
    draws = np.random.default_rng(0)
    image = draws.uniform(2, 60, (2, 16, 64)).astype(np.float32)
    lost = draws.random((16, 64)) < share
    image[:, lost] = value
    np.save(tmp_path / "scan.npy", image)
    read = read_range_image(tmp_path / "scan.npy")
    np.testing.assert_array_equal(read[0], np.where(lost, 0, image[0]))
    assert not read[1][lost].any()


def test_millimetres_and_model_space_are_still_refused(tmp_path):
    draws = np.random.default_rng(0)
    for image in (draws.uniform(2000, 60000, (1, 16, 64)), draws.uniform(-1, 0.5, (2, 16, 64))):
        np.save(tmp_path / "scan.npy", image.astype(np.float32))
        with pytest.raises(InputError, match="millimetres, or a scan in model space"):
            read_range_image(tmp_path / "scan.npy")


@pytest.mark.parametrize("ending", [".bin", ".pcd", ".ply", ".npy", ".csv", ".pcd.bin", ".pkl.gz"])
def test_pointers_of_git_are_named_in_every_format(tmp_path, ending):
    path = tmp_path / f"scan{ending}"
    path.write_text(
        f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 1234567\n"
    )
    with pytest.raises(InputError, match="a Git LFS pointer, not the file itself: git lfs pull"):
        read_points(path)
    path.write_text("/annex/objects/SHA256E-s1--0.bin\n")
    with pytest.raises(InputError, match="a git-annex pointer"):
        read_points(path)


@pytest.mark.parametrize("ending", [".mcap", ".bag", ".db3", ".ckpt", ".safetensors"])
def test_pointers_to_recordings_and_checkpoints_are_named(tmp_path, ending):
    readers = {".ckpt": read_checkpoint, ".safetensors": read_tensors}
    path = tmp_path / f"file{ending}"
    path.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 9\n")
    with pytest.raises(InputError, match="a Git LFS pointer, not the file itself: git lfs pull"):
        readers.get(ending, lambda path: next(read_bag(path)))(path)


def ply(kind: str, name: str, count: int, row: str) -> str:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {count}\n{axes}property {kind} {name}\nend_header\n"
    )
    return head + count * f"1 2 3 {row}\n"


@pytest.mark.parametrize(
    "name",
    [
        "rgb",
        "red",
        "nx",
        "normal_x",
        "timestamp",
        "time",
        "t",
        "gps_time",
        "label",
        "valid",
        "is_ground",
        "packed_rgb",
        "n_x",
        "nanosec",
        "semantic",
        "intensity_index",
    ],
)
def test_what_is_no_reflectance_is_not_proposed_as_one(tmp_path, caplog, name):
    _warned.clear()
    (tmp_path / "scan.ply").write_text(ply("float", name, 3, "5"))
    assert read_points(tmp_path / "scan.ply").reflectance is None
    assert "=reflectance" not in caplog.text
    (tmp_path / "other.ply").write_text(ply("float", "strength", 3, "5"))
    read_points(tmp_path / "other.ply")
    assert "--columns strength=reflectance" in caplog.text


def test_a_ply_of_bool_no_vertices_or_lists_is_answered_in_words(tmp_path):
    path = tmp_path / "scan.ply"
    path.write_text(ply("bool", "valid", 3, "1"))
    np.testing.assert_array_equal(read_points(path).xyz, [[1, 2, 3]] * 3)
    path.write_text(ply("bool", "valid", 0, ""))
    with pytest.raises(NoPointsError, match="it holds no points: leave it out"):
        read_points(path)
    path.write_text("ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(InputError, match="it has no element 'vertex', the points"):
        read_points(path)
    path.write_text(ply("list uchar int", "echoes", 3, "1 4"))
    with pytest.raises(InputError, match="have a property 'uchar int echoes', a list"):
        read_points(path)


def test_as_many_names_are_advised_as_there_are_columns(tmp_path):
    for width in (5, 7):
        np.save(tmp_path / "scan.npy", np.ones((4, width)))
        names = ",".join(["x", "y", "z", "intensity", "_", "_", "_"][:width])
        with pytest.raises(
            InputError, match=f"{width} columns, not 4: name all by --columns {names} "
        ):
            read_points(tmp_path / "scan.npy")


def test_points_in_numpy_s_format_are_read_beside_another_file_of_their_name(tmp_path):
    image, points = tmp_path / "scan.npy", tmp_path / "scan.bin"
    for path in (image, points):
        path.touch()
    assert points_beside(image) == image
    (tmp_path / "manifest.json").touch()  # r2flow wrote both
    assert points_beside(image) == points
