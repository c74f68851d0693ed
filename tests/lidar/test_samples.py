"""Samples as the published codes of R2Flow and R2DM write them."""

import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import torch

import r2flow
from r2flow.base.errors import InputError
from r2flow.lidar.scan_files import read_points, read_range_image
from tests.lidar.conftest import assert_points

DRAW = torch.Generator().manual_seed(0)


def sample(channels: int = 1, rows: int = 8, columns: int = 64) -> dict[str, torch.Tensor]:
    xyz = torch.rand(3, rows, columns, generator=DRAW) * 20 + 1
    xyz[:, :, :9] = 0  # rays without return
    reflectance = torch.rand(channels, rows, columns, generator=DRAW)
    return {"depth": xyz.norm(dim=0, keepdim=True), "xyz": xyz, "reflectance": reflectance}


@pytest.mark.parametrize("stacked", [False, True], ids=["r2flow", "r2dm"])
def test_a_sample_is_an_image_and_points(tmp_path, stacked: bool):
    stored = sample()
    path = tmp_path / "sample_0000000000.pth"
    torch.save(torch.cat(list(stored.values())) if stacked else stored, path)
    image = torch.cat([stored["depth"], stored["reflectance"]])
    np.testing.assert_array_equal(read_range_image(path), image)
    np.testing.assert_array_equal(r2flow.read(path), image * (image[:1] > 0))
    xyz = stored["xyz"].flatten(1).T
    assert_points(read_points(path), xyz, stored["reflectance"].flatten())


def test_a_sample_of_range_alone(tmp_path):
    stored = sample(channels=0)
    torch.save(stored, tmp_path / "a.pth")
    np.testing.assert_array_equal(read_range_image(tmp_path / "a.pth"), stored["depth"])
    assert read_points(tmp_path / "a.pth").reflectance is None


class Harmful:
    def __reduce__(self):
        return (print, ("unpickled",))


@pytest.mark.parametrize(
    ("stored", "words"),
    [
        (OrderedDict(weight=torch.ones(3)), "no sample of the published"),
        (torch.ones(2, 8, 64), "no sample"),
        (sample() | {"depth": torch.ones(8, 64)}, r"depth is \(8, 64\), not \(1, H, W\)"),
        (sample() | {"xyz": torch.ones(3, 8, 32)}, r"xyz is \(3, 8, 32\)"),
        (sample() | {"extra": Harmful()}, "Weights only|weights_only|UnpicklingError"),
        (dict.fromkeys(("depth", "xyz", "reflectance"), torch.ones(1).expand(1, 8, 9)), "xyz is"),
    ],
)
def test_what_is_no_sample_is_one_line(tmp_path, capsys, stored, words):
    torch.save(stored, tmp_path / "a.pth")
    for read in (read_points, read_range_image):
        with pytest.raises(InputError, match=words):
            read(tmp_path / "a.pth")
    assert capsys.readouterr().out == ""


def test_a_view_of_one_number_is_not_expanded(tmp_path):
    one = torch.ones(1)
    views = {"depth": 1, "xyz": 3, "reflectance": 1}
    huge = {name: one.expand(count, 10**5, 10**5) for name, count in views.items()}
    torch.save(huge, tmp_path / "a.pth")
    with pytest.raises(InputError, match="larger than the file"):
        read_range_image(tmp_path / "a.pth")


def test_a_damaged_sample_is_one_line(tmp_path):
    path = tmp_path / "a.pth"
    torch.save(sample(), path)
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("a/data/1").header_offset + 200
    damaged = bytearray(path.read_bytes())
    damaged[start] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(InputError, match="its part a/data/1 is damaged"):
        read_range_image(path)
