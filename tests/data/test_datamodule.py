import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.utils.data import Dataset

from r2flow.base import noise
from r2flow.base.errors import InputError
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.described import describe
from r2flow.data.files import ScanFiles
from r2flow.data.prepared import PreparedScans
from r2flow.data.resolving import reflectance_levels
from r2flow.data.sources import InMemory
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS
from tests.conftest import folder_of, memory_below, numbers, prepare_folder, write_scan

SENSOR = SENSORS["hdl64e"].resized(16, 64)


def module(encoding: Encoding | None = None, **options) -> ScanDataModule:
    data = ScanDataModule(sensor=SENSOR, encoding=encoding or Encoding(SENSOR), **options)
    data.read()
    return data


def mixed(tmp_path: Path, weights=(3, 1), **options) -> ScanDataModule:
    parts = [
        {"name": "folder", "root": str(folder_of(tmp_path / "a", 0, 8))},
        {"name": "odometry", "root": str(tmp_path / "b"), "split": "train"},
    ]
    folder_of(tmp_path / "b/sequences/00/velodyne", 20, 4)
    folder_of(tmp_path / "b/sequences/08/velodyne", 30, 4)
    for part, weight in zip(parts, weights, strict=True):
        part |= {} if weight is None else {"weight": weight}
    return module(name="mixed", parts=parts, **options)


def test_each_part_of_a_mixture_holds_out_a_block_of_its_own(tmp_path: Path):
    data = mixed(tmp_path, validation={"share": 0.25})
    assert numbers(data.training_source) == [0, 1, 2, 3, 4, 5, 20, 21, 22]
    assert numbers(data.validation_source) == [6, 7, 23]
    assert data.summary() == "6 folder scans and 3 odometry scans, 3 held out"


def test_weights_are_shares_and_without_them_every_scan_counts_once(tmp_path: Path):
    data = mixed(tmp_path, validation={"share": 0})
    order = data._order(data.training_source)
    assert sum(order[k] < 8 for k in range(2000)) / 2000 == pytest.approx(3 / 4, abs=0.05)
    data = mixed(tmp_path, weights=(None, None), validation={"share": 0})
    assert sorted(data._order(data.training_source)[k] for k in range(12)) == list(range(12))


def test_the_fingerprint_knows_the_parts_of_a_mixture_and_not_where_they_lie(tmp_path: Path):
    first = mixed(tmp_path / "here").fingerprint()
    assert mixed(tmp_path / "there").fingerprint() == first
    write_scan(tmp_path / "there/b/sequences/00/velodyne/000040.bin", 40)
    assert mixed(tmp_path / "there").fingerprint() != first


@pytest.mark.parametrize("held_out", [False, True])
def test_the_fingerprint_knows_other_scans_of_the_same_names_and_a_copy(
    numbered: Path, tmp_path: Path, held_out: bool
):
    def fingerprint(name: str, root: Path) -> str:
        other = {"name": name, "root": str(root)}
        options = {"validation": {"data": other}} if held_out else other
        return module(**{"name": "simulated", "scenes": 3, **options}).fingerprint()

    # with other times
    copy = shutil.copytree(numbered, tmp_path / "copy", copy_function=shutil.copyfile)
    prepared = [
        prepare_folder(folder, tmp_path / f"of {folder.name}", SENSOR)
        for folder in (numbered, copy)
    ]
    first = fingerprint("folder", numbered), fingerprint("prepared", prepared[0])
    assert (fingerprint("folder", copy), fingerprint("prepared", prepared[1])) == first
    for number in range(12):
        write_scan(copy / f"{number:06d}.bin", 20 + number)
    shutil.rmtree(prepared[1])
    other = (
        fingerprint("folder", copy),
        fingerprint("prepared", prepare_folder(copy, prepared[1], SENSOR)),
    )
    assert not set(first) & set(other)


def test_the_fingerprint_knows_the_simulator_s_revision_where_it_is_used(
    numbered: Path, monkeypatch
):
    drawn, read = (
        module(scenes=3).fingerprint(),
        module(name="folder", root=str(numbered)).fingerprint(),
    )
    monkeypatch.setattr("r2flow.simulator.REVISION", 10**6)
    assert module(scenes=3).fingerprint() != drawn
    assert module(name="folder", root=str(numbered)).fingerprint() == read


def test_the_fingerprint_does_not_know_how_the_root_was_written(numbered: Path, monkeypatch):
    monkeypatch.chdir(numbered.parent)
    name = numbered.name
    written = [str(numbered), name, f"./{name}", f"{name}//", f"../{numbered.parent.name}/{name}"]
    assert len({module(name="folder", root=root).fingerprint() for root in written}) == 1


FOLDER = {"name": "folder", "root": "x"}
DRIVES = {"name": "kitti_360", "root": "x"}


def mixture(part) -> dict:
    return {"name": "mixed", "parts": [part, FOLDER]}


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"batch_size": 0}, "batch_size"),
        ({"validation": {"shar": 0.1}}, r"no option 'validation.shar'"),
        ({"name": "kitti_360"}, "data.root=FOLDER"),
        ({**FOLDER, "split": "train"}, "no standard split"),
        ({**FOLDER, "parts": [FOLDER]}, "data.parts needs data=mixed"),
        ({**FOLDER, "reading": {"on_bad_scan": "ignore"}}, "reading.on_bad_scan: .*found 'ignore'"),
        (
            {"name": "pairs", "root": "x", "scans": DRIVES},
            r"data\.scans: kitti_360 has a standard split: give split",
        ),
        ({"name": "pairs", "root": "x", "scans": {**DRIVES, "split": None}}, "x is not a folder"),
        ({"name": "mixed"}, "data=mixed needs its parts"),
        (mixture({"root": "x"}), r"data.parts\[0\] needs the name"),
        (
            mixture({"name": "folder", "rot": "x"}),
            r"data.parts\[0\]: no option 'rot'.*Did you mean 'root'",
        ),
        (mixture(DRIVES), "has a standard split: give split, one of train, test, or null"),
        (mixture({**FOLDER, "weight": 1}), "every part a weight"),
        (mixture({"name": "simulated", "sensor": {"name": "vlp"}}), "no sensor named .vlp"),
        (mixture({**FOLDER, "weight": 0}), "weight: input should be greater than 0, found 0"),
        (
            {"validation": {"data": {"name": "simulated", "drives": [1]}}},
            "data.drives does nothing for simulated",
        ),
        (
            {"validation": {"data": {"name": "simulated", "root": 512}}},
            "data.root does nothing for simulated",
        ),
        (mixture("folder"), "parts.0: input should be a valid dictionary, found 'folder'"),
        (
            mixture({"name": "simulated", "scenes": 2**31}),
            "scenes: input should be less than or equal to 10000000",
        ),
    ],
)
def test_what_cannot_be_is_refused(options: dict, word: str):
    with pytest.raises(InputError, match=word):
        module(**options)


def test_scans_that_are_trained_on_and_held_out_are_said(numbered: Path, tmp_path: Path, caplog):
    folder_of(tmp_path / "other", 20, 2)
    module(
        name="folder",
        root=str(numbered),
        validation={"data": {"name": "folder", "root": str(tmp_path / "other")}},
    )
    assert caplog.text == ""
    module(
        name="folder",
        root=str(numbered),
        validation={"data": {"name": "folder", "root": str(numbered)}},
    )
    assert "12 held-out scans are trained on" in caplog.text
    (tmp_path / "other" / "file.bin").symlink_to(numbered / "000002.bin")
    (tmp_path / "other" / "folder").symlink_to(numbered)
    module(
        name="folder",
        root=str(numbered),
        validation={"data": {"name": "folder", "root": str(tmp_path / "other")}},
    )
    assert f"trained on, as {numbered / '000000.bin'}" in caplog.messages[-1]
    (tmp_path / "other" / "folder").unlink()
    module(
        name="folder",
        root=str(numbered),
        validation={"data": {"name": "folder", "root": str(tmp_path / "other")}},
    )
    assert "1 held-out scans are trained on" in caplog.messages[-1]


def test_a_part_that_trains_on_what_another_holds_out_is_said(
    numbered: Path, tmp_path: Path, caplog
):
    folder_of(tmp_path / "other", 20, 2)  # the last of them held out
    parts = [{"name": "folder", "root": str(root)} for root in (numbered, tmp_path / "other")]
    for link, scan, said in (
        ("0", "000000", ""),
        ("00", "000011", "1 held-out scans are trained on"),
    ):
        (tmp_path / "other" / f"{link}.bin").symlink_to(numbered / f"{scan}.bin")
        module(name="mixed", parts=parts)
        assert said in caplog.text
        assert bool(said) == bool(caplog.text)


def test_scans_are_projected_as_the_run_says(numbered: Path):
    # of one point
    with pytest.raises(InputError, match="neither ring after ring nor in whole firings"):
        module(name="folder", root=str(numbered), reading={"projection": "unfolding"})


def test_validation_is_never_augmented_nor_drawn_anew_and_ranks_share_it(numbered: Path):
    options = {
        "name": "folder",
        "root": str(numbered),
        "validation": {"share": 0.5},
        "batch_size": 8,
    }
    plain = next(iter(module(**options).val_dataloader()))
    data = module(**options, augment={"flip": True, "roll": True})
    data.seed = 5
    data.item_format = data.format._replace(
        further=lambda x, _, draws: {"drawn": torch.tensor(draws.integers(2**40))}
    )
    augmented = next(iter(data.val_dataloader()))
    assert torch.equal(plain["x_1"], augmented["x_1"])
    assert augmented["drawn"].tolist() == [
        noise.generator(0, "condition", k).integers(2**40) for k in range(6)
    ]


@pytest.mark.parametrize("batch_size", [1, 2, 4, 8])
@pytest.mark.parametrize("ranks", [1, 2, 3, 4, 5, 6, 7])
def test_devices_share_the_held_out_scans_each_once(numbered: Path, ranks: int, batch_size: int):
    data = module(
        name="folder", root=str(numbered), validation={"share": 0.5}, batch_size=batch_size
    )

    def seen(loader: str) -> list[list[list[int]]]:
        found = []
        for rank in range(ranks):
            data.trainer = SimpleNamespace(global_rank=rank, world_size=ranks)
            found.append([batch["k"].tolist() for batch in getattr(data, loader)()])
        return found

    for loader in ("val_dataloader", "test_dataloader"):
        batches = seen(loader)
        assert len(set(map(len, batches))) == 1  # or devices would wait for each other
        numbers = [[k for batch in one for k in batch] for one in batches]
        if ranks <= 6:
            assert sorted(k for one in numbers for k in one) == list(range(6))
        else:  # fewer than devices: all on each
            assert numbers == ranks * [list(range(6))]
    predicted = [k for one in seen("predict_dataloader") for batch in one for k in batch]
    assert sorted(predicted) == list(range(6))


def learns_reflectance(wanted: bool | str, **options) -> bool:
    return ScanDataModule(
        sensor=SENSOR, encoding={"reflectance": wanted}, **options
    ).encoding.reflectance


class TestReflectance:
    """encoding.reflectance=auto: what the scans do not have is not asked for."""

    def test_one_part_without_it_is_enough(self, numbered: Path, tmp_path: Path):
        root = tmp_path / "other"
        write_points(root / "scan.ply", np.array([[10, 0, -1]], np.float32))
        parts = [{"name": "folder", "root": str(numbered)}, {"name": "folder", "root": str(root)}]
        assert not learns_reflectance("auto", name="mixed", parts=parts)
        held = {"validation": {"data": {"name": "folder", "root": str(root)}}}
        assert not learns_reflectance("auto", name="folder", root=str(numbered), **held)

    def test_a_bad_first_scan_is_passed_over_where_bad_scans_are(self, numbered: Path):
        (numbered / "000000.bin").write_bytes(b"")
        data = {"name": "folder", "root": str(numbered)}
        assert learns_reflectance("auto", **data, reading={"on_bad_scan": "skip"})
        with pytest.raises(
            InputError, match=r"000000.bin: it holds no points.* data.reading.on_bad_scan=skip"
        ):
            learns_reflectance("auto", **data)

    def test_what_is_said_is_not_asked(self):
        nowhere = {"name": "folder", "root": "/nowhere"}
        assert learns_reflectance(True, **nowhere)
        assert not learns_reflectance(False, **nowhere)
        with pytest.raises(
            InputError, match="reflectance: input should be a valid boolean.* found 'maybe'"
        ):
            learns_reflectance("maybe", **nowhere)


@pytest.fixture
def prepared_360(kitti_360: Path, tmp_path: Path) -> Path:
    return prepare_folder(kitti_360, tmp_path / "prepared", SENSOR, "kitti_360")


class TestPrepared:
    def test_they_are_the_scans_of_the_raw_files(self, kitti_360: Path, prepared_360: Path):
        options = {"split": "train", "validation": {"share": 0.3}}
        raw = module(name="kitti_360", root=str(kitti_360), **options)
        prepared = module(name="prepared", root=str(prepared_360), **options)
        assert (
            numbers(prepared.training_source)
            == numbers(raw.training_source)
            == [9, 10, 11, 12, 13, 14]
        )
        # a whole drive
        assert numbers(prepared.validation_source) == numbers(raw.validation_source) == [30, 31, 32]
        assert isinstance(prepared.training_source.parts[0], PreparedScans)  # mapped, not copied

    def test_samples_get_the_levels_that_sets_share(self, prepared_360: Path, numbered: Path):
        prepared, simulated = describe(prepared_360), describe("simulated:0")
        assert reflectance_levels([prepared]) == 256  # as prepare found them
        assert reflectance_levels([simulated]) == 100
        assert reflectance_levels([prepared, simulated]) is None
        assert reflectance_levels([describe(numbered)]) is None

    def test_they_mix_with_others(self, prepared_360: Path, numbered: Path):
        parts = [{"name": "prepared", "root": str(prepared_360), "split": "train"},
                 {"name": "folder", "root": str(numbered)}]  # fmt: skip
        held = {"name": "prepared", "root": str(prepared_360), "split": "test"}
        data = module(name="mixed", parts=parts, validation={"data": held})
        assert [type(part) for part in data.training_source.parts] == [PreparedScans, InMemory]
        assert numbers(data.training_source) == [9, 10, 11, 12, 13, 14, 30, 31, 32, *range(12)]
        assert numbers(data.validation_source) == [0, 1, 2, 6, 7, 8]
        dataset = data._dataset(data.training_source, "training")
        for index in (0, 12):
            expected = data.encoding.encode(torch.from_numpy(data.training_source[index]))
            assert torch.equal(dataset[(5, index)]["x_1"], expected)

    def test_test_drives_among_them_are_said(self, prepared_360: Path, caplog):
        module(name="prepared", root=str(prepared_360), split="test")
        assert "takes all of them" not in caplog.text
        module(name="prepared", root=str(prepared_360))
        assert "holds test and train drives, and data.split=null takes all of them" in caplog.text


def test_the_index_of_a_whole_data_set_is_small(tmp_path: Path, monkeypatch):
    for drive in (0, 2, 3, 4, 5, 6, 7, 9, 10):
        write_scan(
            tmp_path
            / f"data_3d_raw/2013_05_28_drive_{drive:04d}_sync/velodyne_points/data/0000000000.bin",
            1,
        )
    # 18,000 scans; all 81,106 then take less than 100 MiB
    frames = [f"{frame:010d}.bin" for frame in range(2000)]
    monkeypatch.setattr("os.listdir", lambda folder: frames)
    with memory_below(100 * 18_000 // 81_106 << 20):
        data = module(name="kitti_360", root=str(tmp_path), memory_gib=0, validation={"scans": 0})
        assert len(data.names) == 18_000


def test_scenes_are_held_out_behind_those_that_are_trained_on():
    data = module(name="simulated", scenes=5, validation={"data": {"scenes": 3}})
    assert list(data.validation_source.names) == ["scene 5", "scene 6", "scene 7"]


@pytest.mark.parametrize("of_two", [0, 1])
def test_images_of_one_channel_are_not_read_into_two(numbered: Path, monkeypatch, of_two):
    monkeypatch.setattr(
        ScanFiles, "__getitem__", lambda _, number: np.ones((1 + (number < of_two), *SENSOR.shape))
    )
    with pytest.raises(InputError, match="found \\(1, "):
        next(iter(module(name="folder", root=str(numbered)).val_dataloader()))


class Walls(Dataset):
    """Scan i is a wall at 5 + i metres."""

    def __len__(self) -> int:
        return 12

    def __getitem__(self, index: int) -> torch.Tensor:
        return torch.full((1, *SENSOR.shape), 5.0 + index)


def test_a_data_set_itself_is_trained_on(tmp_path: Path):
    data = ScanDataModule(
        Walls(), SENSOR, {"reflectance": "auto"}, batch_size=2, validation={"share": 0.25}
    )
    data.read()
    assert numbers(data.training_source) == [*range(9)]
    assert numbers(data.validation_source) == [9, 10, 11]
    x_1 = next(iter(data.val_dataloader()))["x_1"]
    expected = data.encoding.encode(torch.stack([Walls()[9], Walls()[10]]))
    assert torch.equal(x_1, expected)
    assert data.fingerprint() != module(name="simulated", scenes=3).fingerprint()
    with pytest.raises(InputError, match="give the data set itself"):
        ScanDataModule(**data.hparams).setup()  # a checkpoint does not hold it
