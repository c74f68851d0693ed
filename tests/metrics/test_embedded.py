"""The extractor that comes with the package: geometry of its inputs, the ring, missing returns, its training."""

import hashlib
import json
import math
import shlex
import tomllib

import numpy as np
import pytest
import torch

from benchmarks import train_extractor as training
from benchmarks.train_extractor import (
    CLASS_OF_LABEL,
    IGNORED,
    Settings,
    judge,
    judge_held_out,
    train,
    write_weights,
)
from r2flow.errors import InputError
from r2flow.hashing import state_hash
from r2flow.lidar.labels import LABELS
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.metrics.extractors import EXTRACTORS, load_extractor
from r2flow.metrics.extractors.embedded import (
    BANDS,
    CHANNELS,
    CLASSES,
    SECTORS,
    SHIPPED,
    STRIDE,
    Embedded,
    EmbeddedRange,
    inputs,
    pooled,
)
from r2flow.metrics.scans import Scans
from r2flow.simulator import simulate
from tests.conftest import ROOT

SENSOR = SENSORS["hdl64e"].resized(16, 128)
TINY = Settings(seed=3, steps=4, batch_size=2, views=("hdl64e 16x64",))


@pytest.fixture(scope="module")
def embedded() -> Embedded:
    return Embedded.trained()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    return torch.from_numpy(np.stack([simulate(SENSOR, 5, index).image for index in range(6)]))


def test_the_shipped_weights_are_small_packaged_and_named_by_their_hash(embedded):
    assert SHIPPED.stat().st_size <= 4 * 2**20
    assert embedded.weights == hashlib.sha256(SHIPPED.read_bytes()).hexdigest()[:12]
    assert embedded.notes["weights_sha256"] == state_hash(embedded.network.state_dict())
    assert {"settings", "simulator", "versions", "held_out", "command"} <= embedded.notes.keys()
    packaged = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["r2flow"]
    assert SHIPPED.relative_to(ROOT / "r2flow").as_posix() in packaged


def test_the_network_of_range_alone_has_its_own_name_and_needs_no_reflectance(embedded, images):
    assert {embedded.name, EmbeddedRange.name} <= set(EXTRACTORS)
    assert embedded.name != EmbeddedRange.name
    assert not any("frd" in name.lower() for name in (embedded.name, EmbeddedRange.name))
    of_range = load_extractor("embedded_range")
    np.testing.assert_array_equal(
        of_range.features(Scans(images, SENSOR)), of_range.features(Scans(images[:, :1], SENSOR))
    )
    with pytest.raises(InputError, match="no reflectance; use .* handcrafted_range"):
        embedded.features(Scans(images[:, :1], SENSOR))


def test_the_network_sees_height_and_slope_in_metres():
    # Flat ground 1.73 m below and, above the horizon, a round wall 10 m away.
    e = SENSOR.rays()[0].double()
    r = torch.where(e < -0.05, -1.73 / e.clamp(max=-0.05).sin(), 10 / e.cos()).float()
    x = inputs(Scans(r[None, None], SENSOR), reflectance=False)[0]
    ground = (e < -0.05) & (r < 63)
    torch.testing.assert_close(x[4][ground] * 4, torch.full_like(r[ground], -1.73))
    assert x[6].abs().max() < 1e-5  # equal along a row
    inside = ground & ground.roll(-1, 0)
    inside[-1] = False
    torch.testing.assert_close(x[7][inside], torch.zeros_like(r[inside]), atol=1e-4, rtol=0)  # it does not rise
    torch.testing.assert_close(x[8][inside], torch.ones_like(r[inside]))
    wall = (e > -0.05) & (e.roll(-1, 0) > -0.05)
    wall[-1] = False
    torch.testing.assert_close(x[7][wall], torch.ones_like(r[wall]))  # straight up
    assert not x[2:4].any()


def test_a_rolled_scan_gives_the_rolled_map_and_turned_sectors(embedded, images):
    x = inputs(Scans(images[:2], SENSOR), reflectance=True)
    rolled = inputs(Scans(images[:2].roll(3 * STRIDE, -1), SENSOR), reflectance=True)
    expected = embedded.network.map(x).roll(3 * STRIDE // 2, -1)
    torch.testing.assert_close(embedded.network.map(rolled), expected, atol=1e-5, rtol=1e-5)
    cells = embedded.features(Scans(images, SENSOR)).unflatten(1, (BANDS, SECTORS, CHANNELS))
    turned = embedded.features(Scans(images.roll(SENSOR.columns // SECTORS, -1), SENSOR))
    torch.testing.assert_close(turned, cells.roll(1, 2).flatten(1), atol=1e-5, rtol=1e-5)


def test_features_are_sums_over_returns_divided_by_rays():
    x, returned = torch.rand(2, CHANNELS, 8, 32), torch.rand(2, 1, 8, 64) < 0.6
    found = pooled(x, returned).unflatten(1, (BANDS, SECTORS, CHANNELS))
    wide = x.repeat_interleave(2, -1)  # each value of the map stands for two columns
    for band in range(BANDS):
        for sector in range(SECTORS):
            cell = (..., slice(4 * band, 4 * band + 4), slice(8 * sector, 8 * sector + 8))
            expected = (wide[cell] * returned[cell]).sum((-2, -1)) / 32
            torch.testing.assert_close(found[:, band, sector], expected)


def test_a_scan_without_a_return_has_no_features_and_leaves_its_neighbours_alone(embedded, images):
    some = images[:3].clone()
    some[1] = 0
    features = embedded.features(Scans(some, SENSOR))
    assert features.shape == (3, Embedded.dim)
    assert features.dtype == torch.float32
    assert features[1].isnan().all()
    torch.testing.assert_close(features[[0, 2]], embedded.features(Scans(images[[0, 2]], SENSOR)), atol=1e-5, rtol=1e-5)


ODD = SENSORS["hdl64e"].resized(10, 37)
ANY = [*(one.resized(columns=128) for _, one in SENSORS.items()), ODD]


@pytest.mark.parametrize("sensor", ANY, ids=lambda one: f"{one.name}-{one.columns}")
def test_any_sensor_and_size_is_measured(embedded, sensor: Sensor):
    scans = Scans(torch.from_numpy(simulate(sensor, 0, 0).image[None]), sensor)
    assert embedded.features(scans).isfinite().all()
    scores = embedded.network(inputs(scans, reflectance=True))
    assert scores.shape == (1, len(CLASSES), *sensor.shape)


def test_more_noise_moves_the_mean_further(embedded, images):
    normal = np.random.default_rng(0).standard_normal((6, *SENSOR.shape)).astype(np.float32)
    clean, moved = embedded.features(Scans(images, SENSOR)).mean(0), []
    for sigma in (0.05, 0.2, 0.8):
        noisy = images.clone()
        noisy[:, 0] += sigma * torch.from_numpy(normal) * (images[:, 0] > 0)
        moved.append(float((embedded.features(Scans(noisy, SENSOR)).mean(0) - clean).norm()))
    assert 0 < moved[0] < moved[1] < moved[2]


def test_it_knows_road_from_wall_on_scenes_it_has_not_seen(embedded):
    # Chance is the share of the most frequent class, about a third.
    sensor = SENSORS["hdl64e"]
    images, classes = training.labelled(sensor, 991, range(2))
    for reflectance in (True, False):
        assert judge(embedded.network, Scans(images, sensor), classes, reflectance)["accuracy"] > 0.7


def test_every_label_of_the_simulator_has_its_class():
    assert CLASSES[CLASS_OF_LABEL[LABELS["moving-car"]]] == "car"
    assert CLASSES[CLASS_OF_LABEL[LABELS["lane-marking"]]] == "road"
    assert CLASS_OF_LABEL[0] == IGNORED
    assert {CLASSES[k] for k in np.unique(CLASS_OF_LABEL) if k >= 0} == set(CLASSES)


def test_accuracy_and_intersection_over_union_by_hand():
    sensor = SENSOR.resized(2, 4)
    scans = Scans(torch.full((1, 1, 2, 4), 9.0), sensor)
    truth = torch.tensor([[[0, 0, 0, 0], [7, 7, 7, IGNORED]]])
    said = torch.tensor([[[0, 0, 0, 7], [7, 7, 5, 5]]])

    def network(x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.one_hot(said, len(CLASSES)).movedim(-1, 1).float()

    found = judge(network, scans, truth, reflectance=False)  # type: ignore[arg-type]
    # class 0: 3 of 4; class 7: 2 of (3 there + 1 too many); class 5 is not there
    assert found == {"accuracy": pytest.approx(5 / 7), "mean_iou": pytest.approx((3 / 4 + 2 / 4) / 2), "classes": 2}


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(training, "COUNTED", 4)
    monkeypatch.setattr(training, "HELD_OUT", 2)


def test_a_training_changes_the_weights_and_its_file_is_the_same_again(tmp_path, small):
    steps, files = [], []
    for name in ("one", "other"):
        network = train(TINY, advance=lambda: steps.append(1))
        write_weights(tmp_path / name, network, TINY, judge_held_out(network, TINY))
        files.append((tmp_path / name).read_bytes())
    assert files[0] == files[1]
    assert len(steps) == 2 * TINY.steps
    untrained = train(Settings(**{**vars(TINY), "steps": 0}))
    first, last = (state_hash(one.state_dict()) for one in (untrained, network))
    assert Embedded.trained(tmp_path / "one").notes["weights_sha256"] == last != first


@pytest.mark.slow
def test_the_number_of_simulating_processes_does_not_change_the_weights(small):
    assert len({state_hash(train(TINY, workers).state_dict()) for workers in (0, 2)}) == 1


@pytest.mark.parametrize("content", [b"", b"no weights at all", json.dumps({}).encode()])
def test_a_file_without_extractor_weights_is_refused(tmp_path, content):
    (tmp_path / "x.safetensors").write_bytes(content)
    with pytest.raises(InputError, match="is not a safetensors file"):
        Embedded.trained(tmp_path / "x.safetensors")


def test_settings_name_each_sensor_in_its_turn():
    settings = Settings()
    turns = [settings.sensor(step) for step in range(2 * len(settings.views))]
    assert turns[0].shape == (64, 1024)
    assert turns[: len(settings.views)] == turns[len(settings.views) :]
    assert math.prod(turns[1].shape) * 8 == math.prod(turns[0].shape)


def test_the_script_trains_judges_and_notes_how_it_is_done_again(tmp_path, small, capsys):
    out = tmp_path / "new" / "mine.safetensors"
    common = ["--workers", "0", "--out", str(out)]
    training.main(["--seed", "1", "--steps", "2", "--batch-size", "2", "--view", "hdl64e 16x64", *common])
    said = capsys.readouterr().out
    for words in ("hdl64e 16x64, range and reflectance", "hdl64e 16x64, range alone", "classes", f"{out}: "):
        assert words in said
    notes = Embedded.trained(out).notes
    assert notes["settings"]["steps"] == 2
    assert set(notes["held_out"]) == {"hdl64e 16x64, range and reflectance", "hdl64e 16x64, range alone"}
    training.main([*shlex.split(notes["command"])[2:], *common])
    assert Embedded.trained(out).notes["weights_sha256"] == notes["weights_sha256"]
