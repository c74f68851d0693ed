"""Ray-drop and reflectance for a given geometry."""

import numpy as np
import pytest
import torch

from r2flow import noise
from r2flow.data.reading import Reading
from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanFiles
from r2flow.errors import InputError
from r2flow.generators import SensorFlow, build_generator
from r2flow.generators.sensor import hidden_returns, target_of
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import read_points, write_points
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.translation import translate
from r2flow.reports.translated import write_translated
from r2flow.samplers import build_sampler
from r2flow.stages import build_stage

CONFIG = {
    "sensor": {"name": "hdl64e", "rows": 16, "columns": 64},
    "encoding": {"format": "logscale", "reflectance": True},
    "backbone": {"name": "local", "channels": 16, "dilations": [1, 2]},
    "generator": {"name": "sensor_flow"},
}
FEW = build_sampler("euler", steps=2)


@pytest.fixture(scope="module")
def model() -> Checkpoint:
    torch.manual_seed(1)
    flow = build_generator(CONFIG).eval()
    with torch.no_grad():
        for weight in flow.parameters():
            if not weight.any():
                weight.normal_(std=0.2)
    return Checkpoint(flow, CONFIG)


@pytest.fixture(scope="module")
def scans() -> torch.Tensor:
    """A round wall with holes under a sky of 4 rows, (2, 2, 16, 64)."""
    draw = torch.Generator().manual_seed(3)
    r = (8 + torch.rand(2, 1, 16, 64, generator=draw)) * (torch.rand(2, 1, 16, 64, generator=draw) > 0.2)
    r[:, :, :4] = 0
    return torch.cat([r, torch.rand(r.shape, generator=draw) * (r > 0)], 1)


def test_ranges_that_stay_are_those_that_were_given_and_the_sky_stays_empty(model, scans):
    found = translate(model, scans, [0, 1], sampler=FEW)
    r, given = found.images[:, 0], scans[:, 0]
    kept = (r > 0) & (given > 0)
    assert 0.2 < kept.sum() / (given > 0).sum() < 1
    assert torch.equal(r[kept], given[kept])
    assert torch.equal(found.filled, (r > 0) & (given == 0))
    assert found.filled.any()
    assert ((r[found.filled] > 7.9) & (r[found.filled] < 9.1)).all()  # between its neighbours
    assert not r[:, :2].any()
    assert ((found.images[:, 1] >= 0) & (found.images[:, 1] <= 1)).all()
    assert not found.images[:, 1][r == 0].any()


def test_a_scan_depends_on_its_number_and_geometry_alone(model, scans):
    both = translate(model, scans, [0, 1], seed=3, sampler=FEW).images
    alone = translate(model, scans[1:, :1], [1], seed=3, sampler=FEW).images
    torch.testing.assert_close(alone[0], both[1], rtol=0, atol=1e-4)
    assert not torch.equal(translate(model, scans[1:], [2], seed=3, sampler=FEW).images[0], both[1])


def test_a_hidden_return_looks_as_a_hole_does(model, scans):
    r, nothing = scans[:1, :1].clone(), torch.zeros(1, 1, 16, 64)
    hidden = torch.zeros(1, 1, 16, 64, dtype=torch.bool)
    hidden[..., 10, 5:8] = True
    without = r * ~hidden
    features, surface, _ = model.generator.geometry(r, hidden, nothing)
    others, same, _ = model.generator.geometry(without, hidden & False, nothing)
    torch.testing.assert_close(features, others)
    assert torch.equal(surface, same)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_as_many_are_hidden_as_asked_for(share):
    found = hidden_returns(torch.randn(40, 2, 32, 64, generator=torch.Generator().manual_seed(0)), share)
    expected = 1 - (1 - share / 2) ** 2  # ones and blobs are drawn apart
    assert found.shape == (40, 1, 32, 64)
    assert float(found.float().mean()) == pytest.approx(expected, abs=0.01)


def test_it_learns_from_the_surfaces_of_scans(model, scans):
    config = {**CONFIG, "data": {"name": "folder", "batch_size": 2}, "seed": 0, "stage": {"name": "sensor"}}
    torch.manual_seed(0)
    learner = build_stage(config, build_generator(CONFIG))
    x_1 = model.encoding.encode(scans)
    one = [learner.further(x, noise.generator(0, "condition", k)) for k, x in enumerate(x_1)]
    again = learner.further(x_1[0], noise.generator(0, "condition", 0))
    assert all(torch.equal(again[name], one[0][name]) for name in again)
    batch = {name: torch.stack([part[name] for part in one]) for name in again}
    batch |= {"x_1": x_1, "x_0": torch.randn(x_1.shape), "k": torch.arange(2)}
    by, losses = torch.optim.Adam(learner.parameters(), 1e-2), []
    for _ in range(160):
        loss = learner.regression_loss(batch, torch.tensor([0.3, 0.7]))
        by.zero_grad()
        loss.backward()
        by.step()
        losses.append(loss.item())
    assert losses[-1] < 0.7 * losses[0]
    sky = {**batch, "target": torch.where(batch["surface"], batch["target"], 9.0)}
    u = torch.tensor([0.3, 0.7])
    with torch.no_grad():
        assert learner.regression_loss(sky, u) != 0
        changed = {**batch, "surface": batch["surface"] & False}
        assert learner.regression_loss(changed, u) == 0


def test_the_target_of_a_scan():
    image = torch.tensor([[[[0.0, 5.0]], [[0.0, 0.75]]]])
    assert target_of(image).tolist() == [[[[-1.0, 1.0]], [[0.0, 0.5]]]]


def test_files_keep_their_names_points_and_labels(model, scans, tmp_path):
    sensor = model.sensor
    xyz, reflectance = image_to_points(scans[0].numpy(), sensor.rays())
    write_points(tmp_path / "in" / "velodyne" / "a.bin", xyz, reflectance)
    ids = (10 + 60 * (xyz[:, 2] > 0)).astype("<u4")
    (tmp_path / "in" / "velodyne" / "a.label").write_bytes(ids.tobytes())
    reading = Reading(sensor, reflectance=False)
    source = ScanFiles([tmp_path / "in" / "velodyne" / "a.bin"], reading, tmp_path / "in")
    found = ScanSet("in", source, sensor)
    assert write_translated(model, found, tmp_path / "out", ["ply"], 0, FEW) == 1
    points = read_points(tmp_path / "out" / "velodyne" / "a.ply")
    labels = np.frombuffer((tmp_path / "out" / "velodyne" / "a.label").read_bytes(), "<u4")
    given = {tuple(point): label for point, label in zip(xyz, ids, strict=True)}
    assert len(labels) == len(points.xyz)
    kept = [(tuple(p), label) for p, label in zip(points.xyz, labels, strict=True) if tuple(p) in given]
    assert len(kept) > 200
    assert all(given[point] == label for point, label in kept)
    assert set(labels.tolist()) <= {10, 70}
    assert write_translated(model, found, tmp_path / "out", ["ply"], 0, FEW) == 0
    with pytest.raises(InputError, match="seed"):
        write_translated(model, found, tmp_path / "out", ["ply"], 1, FEW)


def test_what_it_is_not_for_is_refused(model, scans):
    with pytest.raises(InputError, match="r2flow translate"):
        model.generator(torch.zeros(1, 2, 16, 64))
    with pytest.raises(InputError, match="16, 64"):
        translate(model, scans[:, :, :8], [0, 1])
    with pytest.raises(InputError, match="reflectance"):
        build_generator({**CONFIG, "encoding": {"format": "logscale", "reflectance": False}})
    plain = {**CONFIG, "generator": {"name": "transfer_flow"}}
    with pytest.raises(InputError, match="experiment=sensor"):
        translate(Checkpoint(build_generator(plain), plain), scans, [0, 1])
    assert isinstance(model.generator, SensorFlow)
