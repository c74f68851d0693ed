import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from r2flow.lidar.encoding import build_space
from r2flow.lidar.projection import image_to_points, project
from r2flow.lidar.sensors import (
    SENSORS,
    Sensor,
    build_sensor,
    named_sensor,
    read_sensor,
    write_sensor,
)
from tests.conftest import refused

CONF = Path(__file__).resolve().parents[2] / "conf" / "sensor"


def test_rays_are_the_middles_of_their_bins(sensor):
    e, a = sensor.rays()
    torch.testing.assert_close(
        torch.rad2deg(e[:, 0]), torch.tensor(sensor.elevations), rtol=0, atol=1e-5
    )
    # Half a bin from +180 degrees on, falling: and so symmetric about straight ahead.
    assert math.degrees(a[0, 0]) == pytest.approx(180 - 180 / sensor.columns, abs=1e-4)
    torch.testing.assert_close(a, -a.flip(1), rtol=0, atol=1e-6)
    assert (a.diff(dim=1) < 0).all()


def test_resizing_keeps_the_field_of_view(sensor):
    height = sensor.shape[0]
    for rows in (height // 2, height, height * 2, height + 3):
        smaller = sensor.resized(rows, 256)
        assert smaller.shape == (rows, 256)
        edges = smaller.row_edges
        assert (
            abs(edges[[0, -1]] - sensor.row_edges[[0, -1]]).max()
            < abs(np.diff(edges)).max() / 2 + 1e-9
        )
    even = Sensor("even", tuple(9.5 - beam for beam in range(40))).resized(10)
    np.testing.assert_allclose(even.row_edges, np.linspace(10, -30, 11), atol=1e-12)


@pytest.mark.parametrize("rows", [20, 32, 48, 64, 128])
def test_more_rows_than_beams_see_the_ground_where_the_beams_meet_it(rows):
    fine, e = (
        SENSORS["vlp16"].resized(rows),
        np.radians(SENSORS["vlp16"].elevations[9:])[:, None],
    )  # within 100 m
    a = np.pi * (1 - 2 * (np.arange(1024) + 0.5) / 1024)  # middles of the columns
    ground = (
        np.stack(np.broadcast_arrays(np.cos(a) / np.tan(-e), np.sin(a) / np.tan(-e), -1.0), -1)
        * 1.8
    )
    xyz, _ = image_to_points(project(ground.reshape(-1, 3), None, fine), fine)
    assert len(xyz) == 7 * 1024
    np.testing.assert_allclose(xyz[:, 2], -1.8, atol=1e-4)
    assert min(fine.row_edges[0], -fine.row_edges[-1]) > 15.2
    assert abs(Sensor("dome", (89.0, 0.0, -89.0)).resized(rows).row_edges).max() < 90


@pytest.mark.parametrize(
    ("name", "lasers"),
    [
        # Laser (in the order of the packets): elevation in degrees, as the manuals print them.
        ("hdl32e", {0: -30.67, 1: -9.33, 2: -29.33, 9: -4.0, 15: 0.0, 30: -10.67, 31: 10.67}),
        ("vlp16", {0: -15, 1: 1, 2: -13, 7: 7, 8: -7, 14: -1, 15: 15}),
        (
            "vlp32c",
            {0: -25, 1: -1, 3: -15.639, 5: 0, 12: -5.333, 25: 7, 29: 15, 30: 10.333, 31: -1.333},
        ),
    ],
)
def test_lasers_fire_in_the_order_of_the_manual(name, lasers):
    for laser, elevation in lasers.items():
        assert SENSORS[name].elevations[SENSORS[name].firing[laser]] == pytest.approx(
            elevation, abs=0.005
        )


@pytest.mark.parametrize(
    ("name", "beams", "top", "bottom", "finest"),
    [
        ("vlp32c", 32, 15, -25, 0.333),
        ("os1_64", 64, 16.6, -16.6, 0.527),
        ("os1_128", 128, 22.5, -22.5, 0.354),
        ("pandar64", 64, 14.882, -24.897, 1 / 6),
    ],
)
def test_fields_of_view_are_the_manuals(name, beams, top, bottom, finest):
    e = np.array(SENSORS[name].elevations)
    assert (len(e), e[0], e[-1]) == pytest.approx((beams, top, bottom), abs=0.005)
    assert -np.diff(e).max() == pytest.approx(finest, abs=0.01)


def test_every_sensor_has_a_config_and_every_config_builds():
    built = []
    for path in CONF.glob("*.yaml"):
        options = yaml.safe_load(path.read_text())
        if base := options.pop("defaults", None):
            options = {**yaml.safe_load((CONF / f"{base[0]}.yaml").read_text()), **options}
        assert options.get("rays", "centre") == "centre"
        sensor = build_sensor(**options)
        built.append(options["name"])
        elevations = (
            options["elevations"]
            if "elevations" in options
            else SENSORS[options["name"]].elevations
        )
        if options.get("rows") in (None, len(elevations)):
            assert list(sensor.elevations) == list(elevations)
    assert set(SENSORS) <= set(
        built
    )  # beside those of the table, a file may describe a sensor of its own


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"elevations": [2, "a"]}, "elevations.1: input should be a valid number"),
        ({"elevations": [2, 10**400]}, "elevations.1: input should be a valid number"),
        ({"elevations": [9, 6, 5, 4, 3, 7, 1]}, "from the top row down within (-90, 90) degrees"),
        ({"elevations": []}, "must be two or more"),
        ({"elevations": [90, 2]}, "within (-90, 90)"),
        ({"elevations": [2, 1], "firing": [0, 0]}, "firing must name"),
        ({"elevations": [2, 1], "firing": [0, 0.5]}, "firing.1: input should be a valid integer"),
        ({"elevations": [2, 1], "height": math.inf}, "height: input should be a finite number"),
        ({"elevations": [2, 1], "height": 0}, "height must be metres above the ground"),
        ({"name": "vlp16", "elevations": [2, 1]}, "another name"),
        ({"elevations": [1, 0], "min_range": 5, "max_range": 4}, "min_range < max_range"),
        ({"elevations": [1, 0], "columns": 0}, "columns"),
        # Sizes that no memory holds are refused before anything is allocated.
        ({"elevations": [1, 0], "columns": 10**13}, "pixels"),
        ({"name": "hdl64e", "rows": 10**13}, "rows must be 2 to 16,384"),
        ({"name": "hdl64"}, "Did you mean 'hdl64e'"),
    ],
)
def test_an_impossible_sensor_of_a_user_is_refused(options, words):
    with refused(words):
        build_space({"sensor": {"name": "mine", **options}, "encoding": {}})


def written(folder: Path, text: str) -> Path:
    (path := folder / "mine.yaml").write_text(text, errors="surrogateescape")
    return path


def test_a_written_sensor_is_read_back(sensor, tmp_path):
    firing = sensor.firing and list(sensor.firing)
    mine = Sensor(
        **{
            **vars(sensor),
            "name": "mine",
            "elevations": np.array(sensor.elevations),
            "firing": firing,
        }
    )
    write_sensor(mine, tmp_path / "mine.yaml", "two\nlines")
    assert read_sensor(tmp_path / "mine.yaml") in {mine}  # equal, with a hash
    assert named_sensor(str(tmp_path / "mine.yaml"), (8, 64)) == mine.resized(8, 64)


def test_a_sensor_of_one_s_own_has_every_option(tmp_path):
    text = "name: mine\nelevations: [2, 1, 0, -1]\nfiring: [3, 1, 0, 2]\nrays: centre\n"
    text += "columns: 64\nmin_range: 1\nmax_range: 50\nheight: 2\n"
    mine = read_sensor(written(tmp_path, text))
    assert mine == Sensor("mine", (2.0, 1.0, 0.0, -1.0), 64, 1.0, 50.0, 2.0, firing=(3, 1, 0, 2))
    assert mine.rays()[0, :, 0].rad2deg().tolist() == pytest.approx([2, 1, 0, -1], abs=1e-6)
    smaller = read_sensor(written(tmp_path, text + "rows: 2\n"))
    assert smaller.elevations == (1.5, -0.5)  # two rows of two beams each
    assert (smaller.shape, smaller.firing) == ((2, 64), None)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("name: \udc80", "not a readable .yaml file"),  # not UTF-8
        ("just text", "is not a sensor"),
        ("1: 2", "needs the option 'name'"),
        ("name: [", "not a readable .yaml file"),
        ("name: !!python/object/apply:os.system [ls]", "not a readable .yaml file"),
        ("name: 2001-13-45", "not a readable .yaml file"),
        ("elevations: [2, 1]", "needs the option 'name'"),
        ("name: mine\nelevations: [2, 1]\ncolums: 3", "Did you mean 'columns'?"),
        ("name: mine\nelevations: 5", "elevations: input should be a list, found 5"),
        ("name: vlp16\nrays: reference", "give sensor.rays=reference"),
    ],
)
def test_a_wrong_file_is_one_line_with_its_name(tmp_path, text, words):
    with refused(words, "mine.yaml"):
        read_sensor(written(tmp_path, text))
