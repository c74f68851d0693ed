"""One opener: what a name may be, whether scans have reflectance, and kinds of scans that a user
adds.
"""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import r2flow
from r2flow.base.errors import InputError
from r2flow.base.noise import standard_normal
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.described import describe
from r2flow.data.detection import reading_for
from r2flow.data.kinds import SOURCES, Layout, SourceKind
from r2flow.data.layouts import Drive
from r2flow.data.loader import ItemFormat
from r2flow.data.opening import open_scans
from r2flow.data.options import PairOptions
from r2flow.data.pairs import PairDataset, PairStore, make_pairs
from r2flow.data.reading import Reading
from r2flow.data.sources import InMemory
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator import simulate
from r2flow.simulator.folder import SimulatedFolder
from r2flow.store import Store
from tests.conftest import numbers, prepare_folder, write_scan
from tests.fields import Field
from tests.simulator.test_folder import write_folder

SENSOR = SENSORS["hdl64e"].resized(8, 32)
READING = Reading(SENSOR)


def learns_reflectance(name: str, root: str) -> bool:
    return ScanDataModule(name, SENSOR, {"reflectance": "auto"}, root=root).encoding.reflectance


def write_image(
    path: Path, number: int, channels: int = 2, size: tuple[int, int] = (8, 32)
) -> Path:
    """A range image whose farthest return lies at 5 + number metres, with reflectance 0.5."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.zeros((channels, *size), np.float32)
    image[0, 1:, :4] = 5 + number
    image[1:, 1:, :4] = 0.5
    np.save(path, image)
    return path


class TestSamples:
    def samples(self, folder: Path, size: tuple[int, int] = (8, 32)) -> Path:
        Store(
            folder, "samples", {"reading": Reading(SENSORS["hdl64e"].resized(*size)).described()}
        ).begin()
        write_image(folder / "000000.npy", 2, size=size)
        return folder

    def test_nobody_types_their_size(self, tmp_path: Path):
        scans = open_scans(self.samples(tmp_path))
        assert scans.sensor == SENSOR
        assert numbers(scans.source) == [2]
        assert describe(tmp_path / "000000.npy").stored == READING  # one of them, too

    def test_another_size_is_one_line(self, tmp_path: Path):
        self.samples(tmp_path)
        said = r"holds images of hdl64e 8x32 \(in its manifest.json\), not of hdl64e 16x64: give no other"
        for name in (tmp_path, tmp_path / "000000.npy"):
            with pytest.raises(InputError, match=said):
                open_scans(name, Reading(SENSORS["hdl64e"].resized(16, 64)))
        with pytest.raises(InputError, match="not of vlp16 8x32"):
            open_scans(tmp_path, Reading(SENSORS["vlp16"].resized(8, 32)))

    def test_points_are_seen_through_any_sensor(self, tmp_path: Path):
        folder = self.samples(tmp_path)
        write_points(
            folder / "000001.ply",
            np.array([[10.0, 0, 0], [0, 20, 0]], np.float32),
            np.ones(2, np.float32),
        )
        seen = open_scans(folder / "000001.ply", Reading(SENSORS["vlp16"].resized(16, 64)))
        assert seen.source[0].shape[-2:] == (16, 64)
        assert sorted(seen.source[0][0][seen.source[0][0] > 0].tolist()) == [10, 20]

    def test_a_run_stands_for_its_samples(self, tmp_path: Path):
        (tmp_path / "config.yaml").touch()
        with pytest.raises(InputError, match="is a run without samples; draw some: r2flow sample"):
            open_scans(tmp_path)
        self.samples(tmp_path / "samples")
        assert open_scans(tmp_path).source.places() == {str(tmp_path / "samples" / "000000.npy")}

    def test_a_folder_that_says_nothing_is_read_as_asked_for(self, tmp_path: Path):
        for place in (tmp_path, tmp_path / "drive"):
            write_image(place / "000000.npy", 2)
            (place / "manifest.json").write_text('{"name": "a data set of mine"}')
        assert describe(tmp_path).stored is None
        assert len(open_scans(tmp_path)) == 2
        with pytest.raises(InputError, match="give --size 8x32"):
            open_scans(tmp_path).source[0]
        assert r2flow.read(tmp_path / "000000.npy").shape == (2, 8, 32)

    def test_a_damaged_or_unreadable_note_is_one_line(self, tmp_path: Path, monkeypatch):
        self.samples(tmp_path)
        for content in (
            "{",
            "1",
            '{"checksum": ""}',
            '{"checksum": "", "recipe": {"reading": {"sensor": {}}}}',
        ):
            (tmp_path / "manifest.json").write_text(content)
            with pytest.raises(InputError, match=r"\A.*manifest.json is damaged.*\Z"):  # one line
                open_scans(tmp_path)
        monkeypatch.setattr(
            "r2flow.store.read_json", Mock(side_effect=OSError(5, "Input/output error"))
        )
        # a working one is not to be removed
        with pytest.raises(OSError, match="Input/output error"):
            open_scans(tmp_path)


class TestWhatR2FlowWrote:
    def test_simulated_scans_need_no_sensor_and_no_size(self, tmp_path: Path, caplog):
        sensor = SENSORS["vlp32c"].resized(16, 64)
        write_folder(SimulatedFolder(tmp_path, sensor, 3, ("ply",)), [5], workers=1)
        reading = reading_for(["simulated:3", tmp_path])
        assert (reading.sensor, reading.reflectance_scale) == (
            replace(sensor, reflectance_scale=None),
            1.0,
        )
        image = simulate(sensor, 3, 5).image
        np.testing.assert_allclose(open_scans(tmp_path, reading).source[0], image, atol=1e-5)
        wrong_scale = replace(reading, reflectance_scale=255.0)
        for name in (tmp_path, tmp_path / "000005.ply"):
            np.testing.assert_allclose(open_scans(name, wrong_scale).source[0], image, atol=1e-5)
        scan, found = r2flow.read(tmp_path / "000005.ply", return_sensor=True)
        assert (scan.dtype, scan.shape) == (torch.float32, (2, 16, 64))
        assert found.same_image(sensor)
        np.testing.assert_allclose(scan.numpy(), image, atol=1e-5)
        assert not caplog.text

    def test_another_sensor_than_their_own_is_warned_of(self, tmp_path: Path, caplog):
        for name in ("pandar64", "vlp16"):
            write_folder(
                SimulatedFolder(tmp_path / name, SENSORS[name].resized(32, 64), 3, ("bin",)),
                [5],
                workers=1,
            )
            open_scans(tmp_path / name, Reading(SENSORS[name].resized(16, 64)))
        assert not caplog.text  # fewer rows are of the same sensor
        # the second one also has a folder of the requested sensor
        for root in (tmp_path / "vlp16", tmp_path):
            caplog.clear()
            open_scans(root, Reading(SENSORS["pandar64"].resized(16, 64)))
            assert "manifest.json names vlp16 32x64; they fit 'vlp16'" in caplog.text

    def test_a_file_is_read_through_any_sensor(self, tmp_path: Path):
        # without reflectance
        write_points(tmp_path / "a.ply", np.array([[10.0, 0, 0]], np.float32))
        for sensor in ("vlp16", SENSORS["vlp16"]):
            scan = r2flow.read(tmp_path / "a.ply", sensor)
            assert scan.shape == (2, *SENSORS["vlp16"].shape)
            assert scan[0].max() == 10
            assert not scan[1].any()
        np.save(
            tmp_path / "a.npy",
            np.full((1, *SENSORS["vlp16"].shape), [10.0, 150.0] * 512, np.float32),
        )
        # it measures up to 100 m
        assert r2flow.read(tmp_path / "a.npy", "vlp16")[0, 0, :2].tolist() == [10, 0]

    def test_reflectance_of_another_scale_is_scaled_and_of_an_uncommon_one_with_a_warning(
        self, tmp_path: Path, caplog
    ):
        for stored, scale, value in (
            (204, None, 0.8),
            (51, 102, 0.5),
            (51, None, 0.51),
            (0.048, None, 0.96),
        ):
            write_points(
                tmp_path / "a.ply",
                np.array([[10.0, 0, 0]], np.float32),
                np.array([stored], np.float32),
            )
            assert float(r2flow.read(tmp_path / "a.ply", "vlp16", scale)[1].max()) == pytest.approx(
                value, abs=1e-6
            )
            # Bytes below 100 may be of 255: only above it are retroreflectors.
            told = {51: "divided by 100", 0.048: "divided by 0.05"}.get(
                stored * (scale is None), ""
            )
            assert told in caplog.text
            assert bool(caplog.text) == bool(told)
            caplog.clear()
        for wrong in (0, -1.0, float("inf"), float("nan")):
            with pytest.raises(InputError, match="reflectance_scale"):
                r2flow.read(tmp_path / "a.ply", "vlp16", wrong)
        with pytest.raises(InputError, match="does not exist. Give a scan"):
            r2flow.read(np.zeros((9999, 4)))


class TestReflectance:
    """One rule: the first scan that has a return decides, and 0 throughout is none."""

    @pytest.mark.parametrize(
        ("case", "expected"),
        [("some", True), ("zeros", False), ("none", False), ("image", True), ("bare image", False)],
    )
    def test_training_and_every_other_use_agree(self, case: str, expected: bool, tmp_path: Path):
        if "image" in case:
            # no return: it decides nothing
            np.save(tmp_path / "0.npy", np.zeros((2, 8, 32), np.float32))
            write_image(tmp_path / "1.npy", 1, channels=1 if case == "bare image" else 2)
        elif case == "none":
            write_points(tmp_path / "0.ply", np.array([[10, 0, -1]], np.float32))
        else:
            write_scan(tmp_path / "0.bin", 1, reflectance=0.5 if case == "some" else 0.0)
        assert learns_reflectance("folder", root=str(tmp_path)) == expected
        for on_bad_scan in ("error", "empty", "skip"):
            scans = open_scans(tmp_path, Reading(SENSOR, on_bad_scan=on_bad_scan))
            assert scans.about["reflectance"] == expected
            assert len(scans.source[len(scans) - 1]) == 1 + expected


def test_a_broken_link_is_not_suggested_for_itself(tmp_path: Path):
    (tmp_path / "b.bin").symlink_to(tmp_path / "gone")
    (tmp_path / "loop").symlink_to("loop")
    assert not describe(tmp_path).manifests
    with pytest.raises(InputError, match=r"b\.bin is a broken link to .*gone\.$"):
        open_scans(tmp_path / "b.bin")
    (tmp_path / "bb.bin").touch()
    with pytest.raises(InputError, match=r"Did you mean 'bb\.bin'\?"):
        open_scans(tmp_path / "bbb.bin")


def test_values_out_of_the_sensor_s_limits_are_dropped_for_a_model_alone(tmp_path: Path):
    image = np.full((2, 8, 32), 0.5, np.float32)
    image[0] = np.resize([1.0, 1.45, 40, 80, 81], (8, 32))
    np.save(tmp_path / "0.npy", image)
    assert open_scans(tmp_path, READING).source[0][0].max() == 81
    seen = open_scans(tmp_path, Reading(SENSOR, within_limits=True)).source[0]
    assert set(np.unique(seen[0]).round(2).tolist()) == {
        0,
        np.float32(1.45).round(2).item(),
        40,
        80,
    }
    assert np.array_equal(seen[1] > 0, seen[0] > 0)


@pytest.fixture
def own_table(monkeypatch) -> None:
    monkeypatch.setattr(SOURCES, "_entries", dict(SOURCES._entries))


def find_weeks(root: Path) -> list[Drive]:
    return [
        Drive(week.name, tuple(map(str, sorted(week.glob("*.bin")))))
        for week in sorted(root.glob("week-*"))
    ]


@pytest.mark.usefixtures("own_table")
def test_a_function_that_finds_drives_and_one_line_are_a_data_set(tmp_path: Path):
    SOURCES.add("bare", Layout(lambda root: []))
    with pytest.raises(InputError, match=r"holds no scan\. Looked for \(bare\): scan files$"):
        open_scans(f"bare:{tmp_path}", READING)
    SOURCES.add(
        "weeks", Layout(find_weeks, splits={"train": ("week-1", "week-2"), "test": ("week-3",)})
    )
    for number in range(9):
        write_scan(tmp_path / f"week-{1 + number // 3}" / f"{number}.bin", number)
    assert numbers(open_scans(f"weeks:{tmp_path}", READING, "test").source) == [6, 7, 8]
    assert ScanDataModule("weeks", SENSOR, root=str(tmp_path)).encoding.reflectance
    held = {"data": {"name": "weeks", "root": str(tmp_path), "split": "test"}}
    data = ScanDataModule("weeks", SENSOR, root=str(tmp_path), split="train", validation=held)
    data.setup()
    assert [len(data.training_source), len(data.validation_source)] == [6, 3]
    prepare_folder(tmp_path, tmp_path / "shards", SENSOR, "weeks")
    assert numbers(open_scans(tmp_path / "shards", split="test").source) == [6, 7, 8]


class WallKind(SourceKind):
    """Scan i is a wall at i + 2 metres."""

    def open(self, scans, reading) -> InMemory:
        walls = range(2, 2 + int(scans.options.root))
        images = np.ones((1, *reading.sensor.shape), np.float32) * np.float32(walls).reshape(
            -1, 1, 1, 1
        )
        return InMemory(images, [f"wall at {wall} m" for wall in walls])

    def lacks_reflectance(self, scans, reading) -> str:
        return "walls have no reflectance"


@pytest.mark.usefixtures("own_table")
def test_scans_that_are_no_files_are_a_kind_of_their_own(r2flow):
    SOURCES.add("walls", WallKind())
    for wrong in (0, -1):
        with pytest.raises(InputError, match=f"num must be at least 1.* found {wrong!r}"):
            open_scans("walls:5", READING, num=wrong)
    with pytest.raises(InputError, match="^0 holds no usable scan of split=None, drives=None"):
        open_scans("walls:0", READING)
    scans = open_scans("walls:5", READING, num=3)
    assert [tuple(batch.shape) for batch in scans.batches([0, 2], 1)] == [(1, 1, 8, 32)] * 2
    assert torch.equal(scans[1:], torch.stack([scans[1], scans[2]]))
    assert scans.identity is None  # nobody knows what decides them: no statistics of them are kept
    assert not learns_reflectance("walls", root="5")
    assert (
        "kid_handcrafted_range"
        in r2flow("evaluate", "walls:5", "walls:4", "--size", "8x32", "--workers", 0).said
    )
    data = ScanDataModule(
        "walls", SENSOR, Encoding(SENSOR, reflectance=False), root=10, batch_size=2
    )
    assert [batch["x_1"].shape for batch in data.val_dataloader()] == [(1, 1, 8, 32)]
    assert data.names == [f"wall at {i} m" for i in range(2, 12)]
    sensors = SENSOR, replace(SENSOR, max_range=9000)
    data, far = (
        ScanDataModule("walls", s, Encoding(s, reflectance=False), root=5000) for s in sensors
    )
    assert next(iter(far.val_dataloader()))["x_1"].isfinite().all()  # walls of 4,752 to 5,001 m
    with pytest.raises(
        InputError, match=r"wall at \d+ m: its median range is .* millimetres\? Give metres"
    ):
        next(iter(data.val_dataloader()))


@pytest.mark.parametrize("shape", [None, (5,)])
def test_noise_has_the_shape_that_the_module_is_told(numbered: Path, shape):
    data = ScanDataModule("folder", SENSOR, seed=7, root=str(numbered), validation={"share": 0.25})
    if shape:
        data.adopt(ItemFormat(data.encoding, shape))
    (batch,) = data.val_dataloader()
    assert set(batch) == {"x_1", "x_0", "u", "k"}
    assert batch["x_1"].shape == (3, 2, 8, 32)
    for k in range(3):
        assert torch.equal(
            batch["x_0"][k], standard_normal(shape or (2, 8, 32), 7, "validation", k)
        )


def test_pairs_are_made_of_noise_of_their_own_shape(tmp_path: Path):
    options = PairOptions(num=4, batch_size=4)
    assert PairStore(tmp_path, options, (2, 4, 8)).noise(3).shape == (2, 4, 8)
    store = PairStore(tmp_path, options, (2, 4, 8), (5,))
    assert torch.equal(store.noise(3), standard_normal((5,), 0, "pairs", 3))
    make_pairs(store, Field(lambda t, x: torch.zeros_like(x), (5,)))
    pair = PairDataset(store, store.usable(), 0, "training")[0, 2]
    assert torch.equal(pair["x_1"], pair["x_0"].half().float())
    with pytest.raises(InputError, match="holds other pairs: noise_shape"):
        PairStore(tmp_path, options, (2, 4, 8))


def test_a_part_of_a_part_is_not_the_same_part_of_the_whole(numbered: Path):
    """Statistics are kept by a set's identity: other scans must have another one."""
    whole = open_scans(numbered, READING)
    for some, other in ((8, 9), (8, None)):
        a, b = (whole.limited(most).part(range(4), "first") for most in (some, other))
        assert numbers(a.source) != numbers(b.source)
        assert a.identity != b.identity


class TestRangeImagesForAModel:
    READ = Reading(SENSOR, within_limits=True, on_bad_scan="error")

    def image(self, path: Path, ranges: float, reflectance: float) -> Path:
        np.save(
            path,
            np.stack([np.full((8, 32), ranges), np.full((8, 32), reflectance)]).astype(np.float32),
        )
        return path

    def test_reflectance_beyond_one_is_not_clipped_in_silence(self, tmp_path: Path):
        path = self.image(tmp_path / "0.npy", 5, 200)
        with pytest.raises(
            InputError,
            match=r"reflectance of a range image lies in \[0, 1\], found up to 200; divide",
        ):
            open_scans(path, self.READ).source[0]
        assert (
            open_scans(self.image(tmp_path / "1.npy", 5, 1.0005), self.READ).source[0][1].max() == 1
        )

    @pytest.mark.parametrize(
        ("ranges", "said"), [(90, "its ranges are up to 90 m."), (0, "its ranges are up to 0 m.")]
    )
    def test_one_without_a_return_is_refused_or_stays_empty(
        self, tmp_path: Path, ranges: float, said: str
    ):
        path = self.image(tmp_path / "0.npy", ranges, 0.5)
        with pytest.raises(InputError, match="has no return from 1.45 to 80 m") as refused:
            open_scans(path, self.READ).source[0]
        assert str(refused.value).endswith(said)
        assert (
            not open_scans(path, Reading(SENSOR, within_limits=True, on_bad_scan="empty"))
            .source[0]
            .any()
        )
