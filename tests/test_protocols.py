"""The paper's protocol and ours, beside what is computed here by other means."""

import json
import math
import random
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.evaluation.measuring import Measurer
from r2flow.evaluation.protocols import PAPER, R2FLOW, _published_choice
from r2flow.lidar.scan_files import write_points
from r2flow.metrics import METRICS
from tests.conftest import SENSOR, folder, images

READING = Reading(SENSOR, convention="reference")
H, W = SENSOR.shape


def angles(
    shift_down: np.ndarray | float, shift_right: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Elevation and azimuth within each bin, both shifts from 0 (upper left corner) to 1, radians."""
    h, w = np.indices((H, W))
    return np.deg2rad(3 - 28 * (h + shift_down) / H), math.pi - 2 * math.pi * (w + shift_right) / W


def points(r: np.ndarray, elevation: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    direction = [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    ]
    return np.moveaxis(r * np.stack(direction), 0, -1)[r > 0]


def on_corners(r: np.ndarray) -> np.ndarray:
    """The published points of an image, in float32: some lie on the border of two cells."""
    h, w = torch.meshgrid(torch.arange(H) / H, torch.arange(W) / W, indexing="ij")
    e, a = ((1 - h) * 28 - 25).deg2rad(), ((1 - w) * 360 - 180).deg2rad()
    depth = torch.from_numpy(r)
    xyz = torch.stack([depth * e.cos() * a.cos(), depth * e.cos() * a.sin(), depth * e.sin()], -1)
    return xyz[depth > 0].double().numpy()


def from_above(clouds: list[np.ndarray]) -> np.ndarray:
    """Points of 3 m < r < 63 m in cells of 1.6 m, over all scans; the edges are the published ones,
    in float32.
    """
    count, edges = np.zeros((100, 100)), torch.linspace(-80, 80, 101).double().numpy()
    for xyz in clouds:
        for x, y, z in xyz:
            if 3 < math.sqrt(x * x + y * y + z * z) < 63:
                count[(edges <= x).sum() - 1, (edges <= y).sum() - 1] += 1
    return count


def distance(a: np.ndarray, b: np.ndarray) -> float:
    p, q = a.ravel() / a.sum(), b.ravel() / b.sum()
    entropy = [-(x[x > 0] * np.log(x[x > 0])).sum() for x in (p, q, (p + q) / 2)]
    return math.sqrt(entropy[2] - (entropy[0] + entropy[1]) / 2)


def discrepancy(a: list[np.ndarray], b: list[np.ndarray]) -> float:
    """Biased MMD of histograms that sum to 1, exp(-|p - q|^2 / (2 * 0.5^2))."""
    p, q = (np.stack([from_above([xyz]).ravel() for xyz in each]) for each in (a, b))
    p, q = (each / each.sum(1, keepdims=True) for each in (p, q))

    def mean(x: np.ndarray, y: np.ndarray) -> float:
        return np.exp(-2 * ((x[:, None] - y) ** 2).sum(2)).mean()

    return mean(p, p) + mean(q, q) - 2 * mean(p, q)


@pytest.fixture
def measured(tmp_path: Path) -> tuple[Path, list[np.ndarray]]:
    draw, clouds = np.random.default_rng(5), []
    for number, image in enumerate(images(6, 1)):
        xyz = points(image[0], *angles(*draw.uniform(0.02, 0.98, (2, H, W)))).astype(np.float32)
        clouds.append(xyz)
        write_points(
            tmp_path / "measured" / f"{number}.bin", xyz, np.full(len(xyz), 0.5, np.float32)
        )
    return tmp_path / "measured", clouds


def figure(real: Path, judged: Path, rules, metric: str = "jsd") -> float:
    metrics = {metric: METRICS[metric]()}
    measurer = Measurer(metrics, rules=rules)
    gathered = measurer.gather(open_scans(str(real), READING))
    (one,) = measurer.measure(gathered, open_scans(str(judged), READING))
    assert one.protocol["name"] == rules.name
    return one.figures[metric]


def test_real_points_are_the_measured_ones_and_generated_ones_bin_corners(measured, generated):
    made = images(10, 2)[:, 0].astype(np.float64)
    corner_clouds = [on_corners(r) for r in images(10, 2)[:, 0]]
    corners = from_above(corner_clouds)
    found = figure(measured[0], generated, PAPER)
    assert found == pytest.approx(distance(from_above(measured[1]), corners), rel=1e-5)
    assert figure(measured[0], generated, PAPER, "mmd") == pytest.approx(
        discrepancy(measured[1], corner_clouds), rel=1e-5
    )
    centres = [
        from_above([points(r, *angles(0.5, 0.5)) for r in both])
        for both in (images(6, 1)[:, 0], made)
    ]
    other = figure(measured[0], generated, R2FLOW)
    assert other == pytest.approx(distance(*centres), rel=1e-3)  # ranges of the files are float32
    assert abs(other / found - 1) > 0.02


def test_the_paper_s_subset_is_its_own_draw_of_all_scans_with_test_drives_last(
    kitti_360, monkeypatch
):
    monkeypatch.setattr("r2flow.evaluation.measuring.REAL_SCANS", 5)
    scans = open_scans(f"kitti_360:{kitti_360}", READING)
    assert [name.split("/")[1][17:21] for name in scans.source.names][:6] == ["0000"] * 3 + [
        "0002"
    ] * 3
    place = list(range(15))
    random.Random(0).shuffle(place)
    theirs = [*range(6, 15), *range(6)]  # drives 3, 4, 10, then 0, 2
    expected = sorted(theirs[p] for p in place[:5])
    assert _published_choice(scans, 5) == expected
    jsd = METRICS["jsd"]()
    of_paper = Measurer({}, rules=PAPER)._scans_for(jsd, scans)
    assert of_paper == (expected, "5 of 15, Python's shuffle, seed 0")
    assert Measurer({})._scans_for(jsd, scans)[0] != expected
    assert _published_choice(open_scans("simulated:0", READING, num=15), 5) == sorted(place[:5])


def test_scans_without_measured_points_are_refused(generated):
    with pytest.raises(InputError, match=r"000000.npy of .* lacks the measured coordinates"):
        PAPER.check(open_scans(str(generated), READING))


def test_several_sets_stand_in_one_table_with_references_and_baselines(
    r2flow, measured, generated, tmp_path, monkeypatch
):
    monkeypatch.setenv("R2FLOW_CACHE", str(tmp_path / "cache"))
    other = folder(tmp_path / "other", images(3, 7))
    options = ("--metrics", "all", "--size", "8x64", "--workers", 0, "--json", tmp_path / "e.json")
    code, said, warned = r2flow(
        "evaluate", measured[0], generated, other, *options, "--protocol", "paper"
    )
    assert code == 0, warned
    lines = said.splitlines()
    assert lines[0].startswith(
        "Protocol paper: real points as measured, generated points on rays through bin corners"
    )
    for words in (
        "generated (10 : 6)",
        "other (3 : 6)",
        "reference: real halves (3 : 3)",
        "baseline: noise (10 : 6)",
    ):
        assert sum(words in line for line in lines) == 1
    assert len(lines) == len(set(lines))
    assert sum("no full rank" in line for line in lines) == 1
    assert sum("r2flow info" in line for line in warned.splitlines()) == 1
    metrics = json.loads((tmp_path / "e.json").read_text())["comparisons"][0]["metrics"]
    figures = {one["metric"]: one["figures"] for one in metrics}
    assert figures["jsd"] == {"jsd": figure(measured[0], generated, PAPER)}
    assert {"mmd", "kid_handcrafted"} <= figures.keys()


def test_a_scan_of_another_scale_is_named_in_one_line(r2flow, measured, generated):
    scan = np.load(generated / "000004.npy")
    scan[1] = 255
    np.save(generated / "000004.npy", scan)
    options = ("--metrics", "frechet_handcrafted", "--size", "8x64", "--workers", 0)
    said = r2flow("evaluate", measured[0], generated, *options).refusal
    assert re.search("scan 000004.npy of .*generated: its reflectance goes up to 255", said)
