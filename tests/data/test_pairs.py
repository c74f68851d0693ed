"""Pairs, their store and their makers. The flow is dx/dt = x, which carries x_0 to e x_0."""

import inspect
import math
import os
import pickle
import signal
import threading
import time
from pathlib import Path

import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.base.noise import standard_normal
from r2flow.base.signals import LATER, Stopped
from r2flow.cli.train import pairs
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.options import PairOptions
from r2flow.data.pairs import PairDataset, PairStore, default_folder, make_pairs
from r2flow.model.lineage import find_parent
from r2flow.model.shipped import find_model
from r2flow.samplers import build_sampler
from r2flow.store import Store
from tests.conftest import files
from tests.fields import Field
from tests.killing import in_child

SHAPE = (2, 4, 8)
OPTIONS = {
    "sampler": {"name": "adams3"},
    "num": 50,
    "batch_size": 4,
    "shard_mib": 3 * 4 * 2 * 64 / 2**20,
    "parent": "abc",
}


def store_in(folder: Path, **options) -> PairStore:
    return PairStore(folder, PairOptions(**{**OPTIONS, **options}), SHAPE)


grow = Field(lambda t, x: x, SHAPE)


def test_a_pair_is_its_noise_and_where_the_flow_carries_it(tmp_path: Path):
    store = store_in(tmp_path, first=70)
    make_pairs(store, grow)
    pairs = PairDataset(store, store.usable(), 0, "training")
    for index in (0, 17, 49):
        x_0, x_1 = pairs[0, index]["x_0"], pairs[0, index]["x_1"]
        assert torch.equal(x_0, standard_normal(SHAPE, 0, "pairs", 70 + index))
        # half precision, solver
        torch.testing.assert_close(x_1, math.e * x_0, rtol=2**-11 + 1e-4, atol=2e-5)


def test_more_pairs_later_by_another_process_are_those_of_one_command(tmp_path: Path):
    make_pairs(store_in(tmp_path / "one"), grow)
    # in batches of 4, and shards of 12
    for num, made in ((3, 4), (20, 20), (20, 0), (50, (13 - 3) * 4)):
        assert len(make_pairs(store_in(tmp_path / "grown", num=num), grow)) == made
        assert len(store_in(tmp_path / "grown", num=num).usable()) == num
    assert files(tmp_path / "one") == files(tmp_path / "grown")


def test_a_damaged_shard_is_found_and_made_again_and_no_other(tmp_path: Path, caplog):
    make_pairs(store_in(tmp_path), grow)
    before = files(tmp_path)
    content = bytearray(before["pairs-000001.safetensors"])
    content[-1] ^= 1  # which the checksum alone tells
    (tmp_path / "pairs-000001.safetensors").write_bytes(content)
    assert len(make_pairs(store_in(tmp_path), grow)) == 12
    assert files(tmp_path) == before
    assert "pairs-000001.safetensors is damaged" in caplog.text


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("parent", "abd"), ("seed", 1), ("sampler", {"name": "exprb43", "tolerance": 1e-3}), ("batch_size", 8),
        ("precision", "bf16-mixed"),
    ],
)  # fmt: skip
def test_other_pairs_in_the_folder_are_refused(tmp_path: Path, option: str, value):
    make_pairs(store_in(tmp_path, num=8), grow)
    with pytest.raises(InputError, match=f"holds other pairs: {option}"):
        store_in(tmp_path, **{option: value})


def test_whole_shards_of_other_pairs_are_never_taken_for_damaged_ones(tmp_path: Path):
    make_pairs(store_in(tmp_path), grow)
    (tmp_path / "manifest.json").unlink()
    before = files(tmp_path)
    with pytest.raises(InputError, match="holds pairs of another recipe"):
        make_pairs(store_in(tmp_path, sampler={"name": "dopri5"}), grow)
    with pytest.raises(InputError, match="holds pairs of another recipe"):
        store_in(tmp_path, sampler={"name": "dopri5"}).usable()
    assert files(tmp_path) == before


def test_one_and_one_point_nought_are_one_tolerance(tmp_path: Path):
    one, other = (
        store_in(tmp_path, sampler={"name": "dopri5", "tolerance": one}) for one in (1, 1.0)
    )
    assert one.described == other.described


def test_a_distilled_flow_draws_pairs_by_its_own_steps_alone(tmp_path: Path):
    flow = Field(lambda t, x: x, SHAPE)
    flow.run_by(build_sampler("euler", steps=2, grid="power:3"), fixed=True)
    with pytest.raises(
        InputError, match="distilled for euler, 2 steps alone: use these, or its parent flow"
    ):
        make_pairs(store_in(tmp_path / "others"), flow)
    assert not (tmp_path / "others").exists()
    own = store_in(tmp_path / "own", sampler={"name": "euler", "steps": 2, "grid": "power:3"})
    assert all(make_pairs(own, flow))


def test_runs_that_share_pairs_share_the_work(tmp_path: Path):
    begun = tmp_path / "begun"

    def slow(t, x):
        if float(t.reshape(-1)[0]) == 0:
            with begun.open("a") as file:
                file.write(".")
        time.sleep(2e-3)
        return x

    children = [
        in_child(lambda: make_pairs(store_in(tmp_path / "pairs", num=200), Field(slow, SHAPE)))
        for _ in range(2)
    ]
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0]
    assert begun.stat().st_size == 50  # batches, each by one of the two
    make_pairs(store_in(tmp_path / "one", num=200), grow)
    assert files(tmp_path / "pairs") == files(tmp_path / "one")


def test_a_pair_that_does_not_come_to_an_end_is_left_out(tmp_path: Path):
    store = store_in(tmp_path, num=8)

    def broken(t, x):
        # The fifth scene starts where no other does, and stays there until it breaks.
        hit = (x - store.noise(5)).abs().amax((1, 2, 3), keepdim=True) < 1e-6
        return torch.where(hit, torch.nan, 0.0) * x

    assert make_pairs(store, Field(broken, SHAPE)).count(False) == 1
    pairs = PairDataset(store, store.usable(), 0, "training")
    assert pairs.numbers.tolist() == [0, 1, 2, 3, 4, 6, 7]
    assert all(pairs[0, i]["x_1"].isfinite().all() for i in range(7))


def test_a_flow_that_is_broken_is_said_to_be(tmp_path: Path):
    with pytest.raises(InputError, match="none of 8 pairs came to an end"):
        make_pairs(store_in(tmp_path, num=8), Field(lambda t, x: x * math.nan, SHAPE))


def test_missing_pairs_are_named(tmp_path: Path):
    make_pairs(store_in(tmp_path, num=8), grow)
    with pytest.raises(InputError, match="lacks about 19 of 19 pairs"):  # not 20, of whole batches
        store_in(tmp_path, num=19).usable()


def test_an_item_has_the_pair_s_noise_and_the_run_s_time(tmp_path: Path):
    store = store_in(tmp_path, num=12)
    make_pairs(store, grow)
    dataset = PairDataset(store, store.usable(), seed=3, purpose="training")
    item = dataset[(70, 11)]
    assert torch.equal(item["x_0"], store.noise(11))
    assert item["k"] == 70
    assert 0 <= float(item["u"]) != float(dataset[(71, 11)]["u"]) < 1
    again = pickle.loads(pickle.dumps(dataset))  # as a loader's worker has it
    assert all(torch.equal(again[(70, 11)][key], item[key]) for key in item)
    store.file(0).write_bytes(b"damaged during the run")
    with pytest.raises(
        InputError, match=r"pairs-000000.safetensors is not a readable .safetensors file"
    ):
        dataset[(70, 11)]


def test_pairs_are_not_kept_among_scans_or_in_another_store(tmp_path: Path):
    (tmp_path / "000000.BIN").touch()
    with pytest.raises(InputError, match=r"holds scans \(000000.BIN\)"):
        store_in(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["000000.BIN"]
    Store(tmp_path / "prepared", "scans", {}).begin()
    with pytest.raises(InputError, match="holds scans, not pairs"):
        store_in(tmp_path / "prepared")


def test_who_waits_says_for_whom_and_who_does_not_leaves_the_rest(
    tmp_path: Path, monkeypatch, caplog
):
    monkeypatch.setattr("r2flow.store.QUIET", 0.1)
    store, (read, write) = store_in(tmp_path), os.pipe()
    child = in_child(
        lambda: store.attempt(
            1, lambda item: (os.write(write, b"1"), os.kill(os.getpid(), signal.SIGSTOP))
        )
    )
    os.read(read, 1)
    assert (len(make_pairs(store, grow, wait=False)), store.missing(store.shards)) == (10 * 4, [1])
    timer = threading.Timer(1, os.kill, (child, signal.SIGKILL))
    timer.start()
    assert len(make_pairs(store, grow)) == 3 * 4
    timer.join()
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    assert caplog.text.count("waiting for ") == 1
    assert not store.missing(store.shards)


def test_a_process_of_a_run_stops_drawing_when_the_one_that_launched_it_is_gone(
    tmp_path: Path, monkeypatch
):
    store = store_in(tmp_path)
    monkeypatch.setattr(
        "os.getppid", lambda: 1 if store.missing(store.shards) != [*store.shards] else 7
    )
    monkeypatch.setenv("LOCAL_RANK", "1")
    with pytest.raises(Stopped) as stopped:
        make_pairs(store, grow)
    assert stopped.value.code == LATER
    # the shard that it was drawing
    assert len(store.missing(store.shards)) == len(store.shards) - 1
    monkeypatch.setenv("LOCAL_RANK", "0")  # the launching process outlives its shell
    monkeypatch.setattr("os.getppid", iter(range(100)).__next__)
    make_pairs(store, grow)
    assert not store.missing(store.shards)


QUICK = ("--sampler", "euler", "--steps", 2, "--batch-size", 4, "--num", 10)


def test_pairs_of_a_run_lie_in_its_folder(r2flow, saved):
    path, _ = saved
    said = r2flow("pairs", path, *QUICK).said
    folder = path.parent.parent / "pairs"
    assert default_folder(Path("models/flow.pth")) == Path("models/flow-pairs")
    assert default_folder(find_model("street")) == Path("runs/street-pairs")  # not in the package
    for words in (
        "12 pairs",
        "pairs/s",
        "2 evaluations a pair",
        f"{folder}: all 10 pairs, 1 shard",
    ):
        assert words in said
    parent = find_parent(path)
    options = {"sampler": {"name": "euler", "steps": 2}, "num": 10, "batch_size": 4}
    data = ScanDataModule("pairs", parent.checkpoint.sensor, pairs=options)
    data.drawn_by(parent.record())
    assert data.pair_store.folder == folder
    assert len(data.pair_store.usable()) == 10
    assert "pairs/s" not in r2flow("pairs", path, *QUICK).said  # nothing was left to make


@pytest.mark.parametrize("option", ["num", "batch_size", "shard_mib", "seed", "precision"])
def test_the_verb_has_the_defaults_of_a_run(option: str):
    assert inspect.signature(pairs).parameters[option].default == getattr(PairOptions(), option)
