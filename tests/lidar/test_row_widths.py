"""Rows of float32 without a header: the width that fits is named, never guessed."""

from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.lidar.scan_files import read_points


def rows(width: int, fill: str, count: int = 3600) -> np.ndarray:
    """Ten turns about a wall, x, y, z, intensity and other columns."""
    azimuth = np.arange(count) * 2 * np.pi / 360
    r = 10 + np.sin(3 * azimuth)
    draw = np.random.default_rng(0)
    table = {
        "zeros": np.zeros((count, width)),
        "time": np.linspace(0, 0.1, count)[:, None] * np.ones(width),
        "numbers": draw.integers(0, 64, (count, width)),
    }[fill]
    columns = [r * np.cos(azimuth), r * np.sin(azimuth), np.arange(count) / count, 0 * r + 0.5]
    table[:, :4] = np.transpose(columns)[:, : min(width, 4)]
    return table.astype("<f4")


@pytest.mark.parametrize("fill", ["zeros", "time", "numbers"])
@pytest.mark.parametrize("width", range(3, 13))
def test_the_width_that_fits_is_named(tmp_path: Path, width: int, fill: str):
    path = tmp_path / "0.bin"
    table = rows(width, fill)
    table.tofile(path)
    if width == 4:
        assert len(read_points(path).xyz) == len(table)
        return
    with pytest.raises(InputError, match=f"rows of {width} float32, not 4") as error:
        read_points(path)
    advised = str(error.value).partition("--columns ")[2].split()[0].split(",")
    np.testing.assert_array_equal(read_points(path, advised).xyz, table[:, :3])


def test_no_width_is_named_where_none_or_several_fit(tmp_path: Path):
    path = tmp_path / "0.bin"
    straight = np.tile(np.float32([1, 1, 0]), 4 * 700)  # all rows of 3 are alike
    shuffled = np.random.default_rng(0).permutation(rows(5, "numbers")).ravel()[:-3]
    for values, words in ((shuffled, "bytes are left"), (straight[:-1], "bytes are left")):
        values.tofile(path)
        with pytest.raises(InputError, match=words) as error:
            read_points(path)
        assert "made of rows of" not in str(error.value).replace("not made of rows of 4", "")
    np.random.default_rng(0).permutation(rows(4, "zeros")).tofile(path)
    assert len(read_points(path).xyz) == 3600  # without order, as named by the ending


@pytest.mark.parametrize(
    ("kind", "named"), [("<f8", "float64"), ("<f2", "float16"), (">f4", "big-endian float32")]
)
def test_rows_of_other_floats_are_named_and_converted(tmp_path: Path, kind: str, named: str):
    path = tmp_path / "0.bin"
    stored = (1.1 * rows(5, "numbers").astype(float)).astype(kind)  # with all bits
    stored.tofile(path)
    with pytest.raises(InputError, match=f"rows of 5 {named}, not float32") as error:
        read_points(path)
    advised = f"numpy.fromfile(FILE, '{kind}').astype('<f4').tofile(OTHER)"
    assert advised in str(error.value)
    np.fromfile(path, kind).astype("<f4").tofile(path)
    np.testing.assert_array_equal(
        read_points(path, ("x", "y", "z", "_", "_")).xyz, stored[:, :3].astype("f4")
    )
