"""What holds for every metric of the table, whatever it measures."""

import copy
import json
import math
import pickle
from dataclasses import asdict
from itertools import chain

import pytest
import torch
from torchmetrics import MetricCollection

from r2flow.base.errors import InputError
from r2flow.metrics import METRICS
from r2flow.metrics.base import SIDES, StoredMetric
from r2flow.metrics.scans import Scans
from tests.metrics.conftest import SMALL, one_of_each_class, scans_of

REAL, GENERATED = 12, 9


@pytest.fixture(params=one_of_each_class())
def build(request, summary):
    return METRICS[request.param]


@pytest.fixture
def sets():
    return {"real": scans_of(REAL, 1), "generated": scans_of(GENERATED, 2, scale=30)}


def part(scans, numbers):
    return Scans(scans.images[numbers], scans.sensor)


def give(metric, sets, size=4, order=1):
    for side, scans in sets.items():
        for first in range(0, len(scans), size)[::order]:
            numbers = range(len(scans))[first : first + size]
            metric.update(part(scans, numbers), side == "real")
    return metric


def test_every_name_is_that_of_its_protocol_and_of_one_figure_only(summary, sets):
    figures: list[str] = []
    for name, build in METRICS.items():
        metric = give(build(), sets)
        assert metric.protocol.metric == name
        json.dumps(asdict(metric.protocol))
        values = metric.compute()
        assert values
        assert all(isinstance(value, float) and math.isfinite(value) for value in values.values())
        figures += values
    assert len(set(figures)) == len(figures)


@pytest.mark.parametrize("processes", [2, 3])
def test_figures_do_not_depend_on_processes_or_the_order_of_scans(build, sets, processes):
    expected = give(build(), sets).compute()
    backwards = give(build(), sets, size=5, order=-1).compute()
    ranks = [build() for _ in range(processes)]
    for side, scans in sets.items():
        for k, first in enumerate(range(0, len(scans), 2)):
            numbers = range(len(scans))[first : first + 2]
            ranks[k % processes].update(part(scans, numbers), side == "real")
    # put together as torchmetrics does it, in the first one
    for name, reduce in ranks[0]._reductions.items():
        values = [getattr(one, name) for one in ranks]
        setattr(
            ranks[0],
            name,
            [*chain(*values)] if isinstance(values[0], list) else reduce(torch.stack(values)),
        )
    shuffled = {s: part(scans, torch.randperm(len(scans))) for s, scans in sets.items()}
    for values in (backwards, ranks[0].compute(), give(build(), shuffled).compute()):
        assert values == pytest.approx(expected, rel=1e-10, abs=1e-13)


def test_an_empty_scan_is_left_out_with_a_remark(build, sets):
    expected = give(build(), sets).compute()
    more = torch.cat([sets["generated"].images, torch.zeros(2, 2, 8, 32)])
    metric = give(build(), {**sets, "generated": Scans(more, SMALL)})
    assert metric.compute() == pytest.approx(expected, rel=1e-9)
    assert any("2 of 11 generated scans are left out" in remark for remark in metric.remarks)


@pytest.mark.parametrize("case", ["all empty", "one alone", "none"])
def test_a_figure_that_does_not_exist_comes_with_a_remark(build, sets, case):
    drawn = sets["generated"].images
    few = {"all empty": 0 * drawn, "one alone": drawn[:1], "none": drawn[:0]}
    metric = give(build(), {**sets, "generated": Scans(few[case], SMALL)})
    missing = [math.isnan(value) for value in metric.compute().values()]
    assert metric.remarks or not any(missing)
    if case == "none":
        assert all(missing)
        assert "there are no generated scans." in metric.remarks
    if case == "all empty":
        assert any("9 of 9 generated scans are left out" in remark for remark in metric.remarks)


def test_equal_sets_are_at_no_distance(build, sets):
    metric = give(build(), dict.fromkeys(SIDES, sets["real"]))
    values = list(metric.compute().values())
    if metric.name.startswith(("kid", "things")):
        assert all(map(math.isfinite, values))
    else:
        assert values == pytest.approx([0] * len(values), abs=1e-9)


def test_statistics_of_the_real_set_replace_its_scans(build, sets):
    whole = give(build(), sets)
    state = {
        name: value.clone()
        for name, value in give(build(), {"real": sets["real"]}).real_state().items()
    }
    again = build()
    for _ in range(2):
        again.reset()
        again.load_real_state(state)
        if isinstance(again, StoredMetric):  # rows are not copied
            assert again.real_rows[0].data_ptr() == state["real_rows"].data_ptr()
        give(again, {"generated": sets["generated"]})
        assert again.compute() == pytest.approx(whole.compute(), rel=1e-12)
    assert again.remarks == whole.remarks


def test_reset_copies_and_pickles(build, sets):
    metric = give(build(), sets)
    expected = metric.compute()
    for other in (copy.deepcopy(metric), metric.clone(), pickle.loads(pickle.dumps(metric))):
        assert other.compute() == expected
        other.reset()
        give(other, dict.fromkeys(SIDES, sets["real"]))
    assert metric.compute() == expected  # the copies' rows are their own
    metric.reset()
    metric.update(part(sets["real"], slice(0, 0)), real=True)  # a batch of no scans changes nothing
    assert give(metric, sets).compute() == expected


def test_in_a_collection_every_metric_has_its_own_figures(summary, sets):
    names = [*one_of_each_class(), "frd", "kid_rangenet53"]
    collection = MetricCollection({name: METRICS[name]() for name in names})
    assert collection(sets["real"], real=True) == {}  # a batch has no distance of its own
    collection.reset()
    together = {
        key.split("/")[-1]: value for key, value in give(collection, sets).compute().items()
    }
    alone = {
        key: value for name in names for key, value in give(METRICS[name](), sets).compute().items()
    }
    assert together == pytest.approx(alone, rel=1e-10)


def test_a_network_runs_once_for_all_metrics_of_it(summary, sets, monkeypatch):
    ran = []
    features = type(summary).features
    monkeypatch.setattr(
        type(summary), "features", lambda self, scans: ran.append(self) or features(self, scans)
    )
    metrics = [METRICS[name]() for name in ("frechet_handcrafted", "kid_handcrafted", "frid")]
    for metric in metrics:
        metric.update(sets["real"], real=True)
    assert [network.name for network in ran] == ["handcrafted", "rangenet21"]


def test_scans_without_reflectance_are_refused_where_it_is_needed(build, sets):
    metric, bare = build(), Scans(sets["real"].images[:, :1], sets["real"].sensor)
    if not metric.needs_reflectance:
        metric.update(bare, real=True)
    metric.needs_reflectance = True
    with pytest.raises(InputError, match=f"'{metric.name}' needs reflectance"):
        metric.update(bare, real=True)


def test_images_need_a_sensor(build, sets):
    metric = build()
    with pytest.raises(InputError, match=rf"^'{metric.name}' needs the sensor"):
        metric.update(sets["real"].images, real=True)
    assert not metric.counts.any()
    assert METRICS["jsd"](sensor="hdl64e").sensor.shape == (64, 1024)


def told(metric, sets, size=4):
    for side, scans in sets.items():
        for batch in scans.images.split(size):
            metric.update(batch, real=side == "real")
    return metric


def test_merged_states_are_those_of_all_scans(build, sets):
    expected = give(build(), sets).compute()
    halves = [
        {s: part(x, numbers) for s, x in sets.items()} for numbers in (slice(0, 5), slice(5, None))
    ]
    parts = [told(build(sensor=SMALL), half) for half in halves]
    parts[1].persistent(True)
    for incoming in (parts[1], parts[1].state_dict()):
        metric = parts[0].clone()
        metric.compute()  # what is computed before is not taken for what is there afterwards
        metric.merge_state(incoming)
        assert metric.compute() == pytest.approx(expected, rel=1e-10, abs=1e-13)


def test_a_loaded_state_goes_on_where_the_saved_one_was(build, sets, tmp_path):
    expected = give(build(), sets).compute()
    begun = build(sensor=SMALL)
    told(begun, {s: part(scans, slice(0, 7)) for s, scans in sets.items()})
    middle = begun.compute()
    begun.persistent(True)
    torch.save(begun.state_dict(), tmp_path / "metric.pt")
    metric = build(sensor=SMALL)
    metric.load_state_dict(torch.load(tmp_path / "metric.pt", weights_only=True))
    assert metric.compute() == middle
    told(metric, {s: part(scans, slice(7, None)) for s, scans in sets.items()})
    assert metric.compute() == pytest.approx(expected, rel=1e-10, abs=1e-13)


def test_moving_and_setting_a_dtype_change_no_figure(build, sets):
    expected = give(build(), sets).compute()
    metric = told(build(sensor=SMALL), sets).set_dtype(torch.float16).half()
    # as a trainer does, which also computes in autocast
    torch.nn.ModuleList([metric]).to("cpu", torch.bfloat16)
    assert metric.compute() == expected
    metric.reset()
    with torch.autocast("cpu", torch.bfloat16):
        assert told(metric, sets).compute() == expected


def images(n=3):
    r = torch.linspace(2, 60, n * 8 * 32).view(n, 1, 8, 32)
    return torch.cat([r, torch.full_like(r, 0.5)], 1)


def broken(change):
    made = images()
    change(made)
    return made


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x: x[1, 1].fill_(255.0), "reflectance goes up to 255"),
        (lambda x: x[1, 1, 0, 0].fill_(float("nan")), "reflectance is NaN"),
        (lambda x: x[1, 0, 2].fill_(float("inf")), "range is NaN or infinite"),
        (lambda x: x[1, 0, 0].fill_(-1.0), "range goes down to -1; 0 stands for no return"),
        (lambda x: x[1].mul_(0).sub_(0.3), r"model space \(\[-1, 1\]\)\? Decode it"),
        (lambda x: x[1, 0].mul_(1000), "are these millimetres"),
        (lambda x: x[1, 1, 0, 0].fill_(-0.2), "reflectance goes down to -0.2"),
    ],
)
def test_values_that_no_scan_has_are_refused_with_the_first_such_scan(change, said):
    made = broken(change)
    with pytest.raises(InputError, match=f"^scan 1: .*{said}"):
        Scans(made, SMALL)
    with pytest.raises(InputError, match=f"^scan b.npy: .*{said}"):
        Scans(made, SMALL, names=["a.npy", "b.npy", "c.npy"])
    metric = METRICS["jsd"](sensor=SMALL)
    metric.update(images(), real=True)
    with pytest.raises(InputError, match=f"^scan 4: .*{said}"):
        metric.update(made, real=True)
    assert metric.counts[0].tolist() == [3, 3]


def test_single_far_returns_and_rounding_are_let_pass():
    Scans(broken(lambda x: x[:, 0, 0, 0].fill_(1e5)), SMALL)
    Scans(broken(lambda x: x[:, 1, 0, 0].fill_(1.0005)), SMALL)
    Scans(torch.zeros(2, 2, 8, 32), SMALL)
    assert len(Scans(torch.zeros(0, 2, 8, 32), SMALL)) == 0


def test_points_lie_on_the_rays_that_are_named_or_where_they_were_measured():
    r = images()[:, :1]
    for rays, shift in (("centre", 0.5), ("reference", 0.0)):
        x, y, _ = Scans(images(), SMALL, rays).xyz[0]
        azimuth = torch.atan2(y, x)[3]
        expected = torch.pi - 2 * torch.pi * (torch.arange(32) + shift) / 32
        assert torch.allclose(torch.cos(azimuth), torch.cos(expected), atol=1e-5)
        assert torch.allclose(torch.sin(azimuth), torch.sin(expected), atol=1e-5)
    measured = torch.randn(3, 3, 8, 32)
    far = torch.cat([torch.where(r > 30, 70, r), images()[:, 1:]], 1)  # beyond the mask
    assert torch.equal(Scans(far, SMALL, xyz=measured).xyz, measured * (r <= 30))
