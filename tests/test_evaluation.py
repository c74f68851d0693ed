"""Generated scans against real ones, with figures that are computed here by other means."""

import json
import math
import shutil
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.base.noise import standard_normal
from r2flow.data.detection import reading_for
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.data.sets import ScanSet, fixed_choice
from r2flow.evaluation import measuring
from r2flow.evaluation.comparing import Comparison, with_equal_panels
from r2flow.evaluation.measuring import (
    Measurer,
    MetricResult,
    Work,
    key_of,
)
from r2flow.evaluation.sets import reference_sets, sampled_set
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.metrics.jsd_mmd import JSD, MMD
from r2flow.metrics.panel import PANEL, REFLECTANCE
from r2flow.reports.verdict import remarks_of, verdict
from r2flow.samplers import build_sampler
from tests.conftest import SENSOR, folder, images
from tests.test_sampling import flow

READING = Reading(SENSOR)


def measured(real: ScanSet, generated: ScanSet, work: Work | None = None):
    measurer = Measurer({"jsd": JSD(), "mmd": MMD()}, work or Work())
    return measurer.measure(measurer.gather(real), generated)


def figures(*given, **how) -> dict[str, float]:
    return {name: value for one in measured(*given, **how) for name, value in one.figures.items()}


def test_figures_do_not_depend_on_order_batches_or_reading_processes(real, generated, tmp_path):
    there = open_scans(str(real), READING)
    expected = figures(there, open_scans(str(generated), READING))
    backwards = folder(tmp_path / "backwards", images(10, 2)[::-1])
    found = figures(
        there.part(range(11, -1, -1), "backwards"),
        open_scans(str(backwards), READING),
        work=Work(1, 1),
    )
    assert found == pytest.approx(expected, rel=1e-10)


def test_any_change_of_what_decides_a_figure_has_another_key(real, tmp_path, monkeypatch):
    def key(
        root: Path = real,
        reading: Reading = READING,
        metric: JSD | None = None,
        rule: str = "all",
    ) -> str:
        return key_of(metric or JSD(), open_scans(str(root), reading), rule)

    first = key()
    assert key() == first

    class Other(JSD):
        protocol = property(
            lambda self: JSD.protocol.fget(self).__class__("jsd", "other", weights="abc")
        )

    keys = [first, key(rule="10 of 12"), *(key(metric=metric) for metric in (MMD(), Other()))]
    changes = {"reflectance": False}, {"projection": "unfolding"}, {"convention": "reference"}
    keys += [key(reading=Reading(SENSOR, **one)) for one in (*changes, {"reflectance_scale": 2})]
    keys.append(key_of(JSD(), open_scans(str(real), READING, num=7), "all"))
    monkeypatch.setattr(measuring, "FORMAT", measuring.FORMAT + 1)
    keys.append(key())
    plugin = tmp_path / "plugin.py"
    monkeypatch.setattr(
        "r2flow.base.plugins._loaded", {str(plugin): "plugin.py", "a.module": "a.module"}
    )
    for code in ("x = 1", "x = 2"):
        plugin.write_text(code)
        keys.append(key())
    monkeypatch.undo()
    scan = real / "000003.npy"
    scan.write_bytes(scan.read_bytes())  # another time, the same content
    keys.append(key())
    np.save(scan, np.zeros((2, 8, 64)))  # another size
    keys.append(key())
    scan.rename(real / "000099.npy")
    keys.append(key())
    assert len(set(keys)) == len(keys)


def test_some_metrics_are_of_the_field_s_subset_and_some_of_every_scan(real, monkeypatch):
    monkeypatch.setattr(measuring, "REAL_SCANS", 5)
    metrics = {"jsd": JSD(), "returns": CountReturns()}
    gathered = Measurer(metrics, Work(batch_size=2)).gather(open_scans(str(real), READING))
    chosen = fixed_choice(12, 5)
    assert [one.choice for one in gathered.values()] == ["5 of 12, fixed shuffle, seed 0", "all 12"]
    assert [one.scans for one in gathered.values()] == [5, 12]
    r = images(12, 1)[:, 0]
    assert gathered["jsd"].states["sums"].sum() == ((r > 3) & (r < 63))[chosen].sum()
    assert gathered["returns"].states["sums"][0] == ((r > 0) & (r < 63)).sum()
    assert metrics["returns"].seen == 12


class CountReturns(JSD):
    """Returns of all scans; it passes for a metric of a network's features, which are given every
    real scan.
    """

    def __init__(self) -> None:
        super().__init__()
        self.seen = 0

    @property
    def protocol(self):
        return type(super().protocol)("returns", "range image", extractor="counter")

    def update(self, scans, real):
        self.sums[0, 0] += scans.returned.sum()
        self.seen += len(scans)


def test_the_fixed_shuffle_is_stated_and_does_not_change():
    assert fixed_choice(7, 7) == list(range(7))
    key = np.array([0, zlib.crc32(b"shuffle")], dtype=np.uint64)
    shuffled = np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, 0])).permutation(
        81106
    )
    assert fixed_choice(81106, 10000)[:3] == sorted(shuffled[:10000])[:3]
    scans = open_scans("simulated:0", READING, num=10_000)
    assert Measurer({})._scans_for(JSD(), scans) == (range(10_000), "all 10000")


class TestSets:
    def test_a_pcd_and_a_pcd_bin_of_a_name_are_one_sample(self, tmp_path):
        cloud = image_to_points(images(1, 2)[0], SENSOR.rays())
        write_points(tmp_path / "a.pcd", *cloud)
        np.column_stack([*cloud, np.zeros(len(cloud[0]))]).astype("<f4").tofile(
            tmp_path / "a.pcd.bin"
        )
        assert open_scans(str(tmp_path), READING).source.names == ["a.pcd.bin"]

    @pytest.mark.parametrize("places", [("", ""), ("velodyne", "labels")])
    def test_labels_beside_generated_scans_change_nothing(self, real, tmp_path, places):
        """SPIRAL's samples: `.bin` of x y z reflectance, `.label` of a uint32 a point."""
        plain = folder(tmp_path / "plain", images(10, 2))
        scans, labels = (tmp_path / "labelled" / place for place in places)
        shutil.copytree(plain, scans)
        labels.mkdir(exist_ok=True)
        for path in scans.glob("*.bin"):
            points = path.stat().st_size // 16
            np.arange(points, dtype=np.uint32).tofile(labels / f"{path.stem}.label")
        both = [open_scans(str(each), READING) for each in (plain, tmp_path / "labelled")]
        assert [len(one) for one in both] == [10, 10]
        truth = open_scans(str(real), READING)
        assert figures(truth, both[0]) == figures(truth, both[1])

    def test_scans_are_read_as_all_parts_of_a_mixture_were(self):
        parts = [
            {"reading": {"convention": "reference", **more}}
            for more in ({"reflectance_scale": 255.0}, {})
        ]
        learned = flow()
        learned.config.stored["data"] = {"name": "mixed", "parts": parts}
        found = reading_for([], learned)
        assert (found.projection, found.convention, found.reflectance_scale) == (
            "spherical",
            "reference",
            1.0,
        )

    def test_a_flow_is_sampled_from_the_noise_of_evaluations(self, real):
        drawn = sampled_set(flow(), "flow", 5, build_sampler("euler", steps=1), seed=9)
        batches = list(drawn.batches(range(5), 2))
        assert [len(batch) for batch in batches] == [2, 2, 1]
        x_0 = standard_normal((2, 8, 64), 9, "evaluation", 3)
        v = flow().generator.velocity(torch.tensor([0.0]), x_0[None])
        torch.testing.assert_close(batches[1][1], flow().encoding.decode(x_0[None] + v)[0])
        assert drawn.source.evaluations == [1] * 5
        assert len(drawn.source.seconds) == 3
        drawn.source.flow.generator.field = lambda condition: lambda t, x: x * math.nan
        for found in (measured(open_scans(str(real), READING), drawn)[0] for _ in range(2)):
            assert "5 of 5 scans are not solved to the tolerance." in found.remarks


class TestExtremes:
    def test_an_empty_scan_counts_and_is_said(self, real, tmp_path):
        made = images(4, 2)
        made[1] = 0
        made[2, 0] = np.where(made[2, 0] > 0, 70, 0)  # beyond the mask
        found = measured(
            *(open_scans(str(one), READING) for one in (real, folder(tmp_path / "g", made)))
        )
        assert all(math.isfinite(value) for one in found for value in one.figures.values())
        assert all(one.protocol["sizes"]["generated_empty"] == 2 for one in found)
        assert all("2 of 4 generated scans" in " ".join(one.remarks) for one in found)

    def test_points_out_of_view_are_an_empty_scan_and_no_points_a_clear_error(self, real, tmp_path):
        write_points(tmp_path / "g" / "0.ply", np.array([[0, 0, 9.0]]), np.array([0.5]))
        assert not open_scans(str(tmp_path / "g"), READING).source[0].any()
        for one in measured(*(open_scans(str(one), READING) for one in (real, tmp_path / "g"))):
            assert any(math.isnan(value) for value in one.figures.values()) <= bool(one.remarks)


def test_references_are_halves_by_block_and_two_drives(kitti_360, tmp_path, monkeypatch):
    real = open_scans(f"kitti_360:{kitti_360}", READING, "train")
    found = reference_sets(
        real, {"generated": open_scans(str(folder(tmp_path / "g", images(8, 2))), READING)}
    )
    assert list(found) == ["real halves", "generated, as many", "real drives"]
    names = real.source.names
    halves = [one.source.names for one in found["real halves"]]
    assert [*halves[0], *halves[1]] == names
    assert len(halves[0]) == 4
    assert [len(one) for one in found["generated, as many"]] == [4, 5]
    sampled = sampled_set(flow(), "flow", 8)
    assert len(reference_sets(real, {"flow": sampled})["flow, as many"][1]) == 5
    monkeypatch.setattr("r2flow.evaluation.sets.AGAIN", 4)
    assert "flow, as many" not in reference_sets(real, {"flow": sampled})
    drives = [
        {name.split("/")[1][17:21] for name in one.source.names} for one in found["real drives"]
    ]
    assert drives == [{"0003"}, {"0004"}]
    with pytest.raises(InputError, match="at least two"):
        reference_sets(real.part([0], "one"))


def test_identity_is_plain_and_holds_no_path(real):
    found = open_scans(str(real), READING)
    assert str(real) not in json.dumps([found.identity, dict(found.about)])


def test_another_revision_of_the_simulator_draws_other_scans(monkeypatch):
    before = open_scans("simulated:0", READING, num=3).identity
    monkeypatch.setattr("r2flow.simulator.REVISION", 10**6)
    assert open_scans("simulated:0", READING, num=3).identity != before


FEW = "too few scans for a verdict: 24 real, 18 generated, 200 and 100 needed"


@pytest.mark.parametrize(
    ("metric", "real", "scans", "value", "equal", "words"),
    [
        ("mine", 200, 200, 9.0, 14.5, "not distinguishable"),  # within the margin
        ("mine", 200, 200, 50.0, 1.0, "no lower than a baseline"),
        ("mine", 200, 20, 9.0, None, "not above the real halves, below the baselines; too few"),
        ("panel", 24, 18, 9.0, 11.0, f"above the real halves, below the baselines; {FEW}"),
        ("panel", 24, 18, 60.0, 9.5, f"not above the real halves, not below the baselines; {FEW}"),
        ("panel", 24, 18, 9.0, None, FEW),
        # the halves' distance is larger since they are fewer
        ("panel", 200, 200, 9.0, None, "give 100 generated"),
        ("panel", 200, 200, 9.0, 9.5, "not distinguishable"),
        ("panel", 200, 200, 9.0, 15.5, "higher than between the real halves"),
        ("panel", 200, 200, 15.5, None, "higher than between the real halves"),
    ],
)
def test_the_verdict_follows_from_reference_and_baselines(metric, real, scans, value, equal, words):
    half = real // 2
    cases = [
        ("b", value + 1, (real, scans), "judged"), ("a", value, (real, scans), "judged"),
        ("real halves", 10.0, (half, half), "reference"), ("noise", 50.0, (real, scans), "baseline"),
    ]  # fmt: skip
    cases += [("a, as many", equal, (half, half), "reference")] * (equal is not None)
    comparisons = [
        Comparison(
            name, *map(range, sizes), [MetricResult(metric, {metric: number}, {}, True)], kind
        )
        for name, number, sizes, kind in cases
    ]
    first, second = verdict(comparisons)
    same = f"in as many scans as the halves {equal:g}, " if equal is not None else ""
    assert first.startswith(
        f"a: {metric} {value:g} ({same}reference: real halves 10, baseline: noise 50): "
    )
    assert words in first
    assert second.startswith(f"b: {metric} {value + 1:g} ")


@pytest.mark.parametrize(
    ("noise", "said"),
    [(9.0, ["do not rank by jsd here: baselines are below the real halves: noise."]), (11.0, [])],
)
def test_a_figure_by_which_a_baseline_is_nearer_than_real_scans_ranks_nothing(noise, said):
    cases = ("a", 7.0, "judged"), ("real halves", 10.0, "reference"), ("noise", noise, "baseline")
    results = [
        (name, [MetricResult("jsd", {"jsd": value}, {}, True)], kind) for name, value, kind in cases
    ]
    assert (
        remarks_of([Comparison(name, range(9), range(9), one, kind) for name, one, kind in results])
        == said
    )


def test_the_verdict_is_of_the_panel_if_measured():
    sizes = {"sizes": {"generated_empty": 3}}
    results = [
        MetricResult(name, {name: value}, sizes, True)
        for name, value in (("jsd", 5.0), ("panel", 7.0))
    ]
    named = (("a", "judged"), ("real halves", "reference"))
    both = [Comparison(name, range(200), range(200), results, kind) for name, kind in named]
    assert verdict(both)[0].startswith("a: panel 7 (reference: real halves 7): not distinguishable")
    assert verdict(both)[0].endswith("; 3 of its scans are empty and not compared.")
    few = [replace(one, real=range(20), generated=range(20)) for one in both]
    assert "not above the real halves; too few" in verdict(few)[0]
    assert (
        verdict(
            [
                replace(one, measured=[MetricResult("kid_x", {"kid_x": 5.0}, {}, False)])
                for one in both
            ]
        )
        == []
    )


def test_panels_are_means_of_the_same_lines():
    lines = dict.fromkeys(PANEL, 0.2)
    panels = [
        {"panel": 0.2, **lines, REFLECTANCE: math.nan},
        {"panel": 0.3, **lines, REFLECTANCE: 1.4},
    ]
    sets = [
        Comparison(str(i), [], [], [MetricResult("panel", one, {}, True)])
        for i, one in enumerate(panels)
    ]
    assert [c.measured[0].figures["panel"] for c in with_equal_panels(sets)] == pytest.approx(
        [0.2, 0.2]
    )
    assert with_equal_panels(sets[1:]) == sets[1:]
