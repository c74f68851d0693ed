"""What a run takes over from the flow that it starts from."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.base.registry import construct
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.options import DataOptions
from r2flow.data.resolving import plan_data
from r2flow.generators import build_generator
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.config import ModelConfig
from r2flow.model.lineage import Parent, find_parent
from r2flow.model.saving import weights_hash
from r2flow.runs.composing import compose
from r2flow.store import Store
from r2flow.training import check
from tests.conftest import CONFIG as BOTH
from tests.conftest import SENSOR, write_checkpoint

ENCODING = {
    "format": "logscale",
    "reflectance": False,
    "limits": "closed",
    "levels": None,
    "labels": False,
}
CONFIG = {**BOTH, "encoding": ENCODING, "backbone": {**BOTH["backbone"], "position": "none"}}


@pytest.fixture
def parent(tmp_path: Path) -> Path:
    return write_checkpoint(tmp_path / "parent.ckpt", CONFIG)


def child(parent: Path, reflectance) -> dict:
    return {
        **CONFIG,
        "encoding": {**ENCODING, "reflectance": reflectance},
        "stage": {"name": "rectify", "parent": str(parent)},
    }


def completed(config: dict, asked: list[str], parent: Parent | None = None) -> dict:
    config = {**compose(["trainer.accelerator=cpu"]), **config}
    return check(config, asked, parent).plain()


@pytest.mark.parametrize("asked", [[], ["encoding"], ["encoding.reflectance"]])
def test_auto_is_what_the_parent_is(parent: Path, asked: list[str]):
    found = completed(child(parent, "auto"), asked)["encoding"]
    assert found == {**ENCODING, "levels": 100.0}  # of the simulated scans


def test_a_channel_that_the_parent_lacks_is_refused(parent: Path):
    with pytest.raises(InputError, match="reflectance is True here, but False in"):
        completed(child(parent, True), ["encoding.reflectance=true"])


def sized(config: dict, rows: int, columns: int, **backbone) -> dict:
    sensor = {"name": "hdl64e", "rows": rows, "columns": columns}
    return {**config, "sensor": sensor, "backbone": {**config["backbone"], **backbone}}


@pytest.mark.parametrize(
    ("asked", "shape"),
    [
        ([], (8, 64)),  # another default sensor is not asked for
        (["sensor=vlp16"], (16, 128)),
        (["sensor.rows=16", "sensor.columns=128"], (16, 128)),
        (["sensor.columns=128"], (8, 128)),
    ],
)
def test_a_sensor_is_the_parents_unless_another_is_asked_for(
    parent: Path, asked: list[str], shape: tuple[int, int]
):
    config = completed(sized(child(parent, False), 16, 128), asked)
    assert (config["sensor"]["rows"], config["sensor"]["columns"]) == shape


def test_pairs_are_images_of_the_parents_sensor(parent: Path):
    pairs = {"name": "pairs", "root": None, "pairs": {}}
    config = {
        **sized(child(parent, False), 16, 128),
        "data": pairs,
        "stage": {"name": "reflow", "parent": str(parent)},
    }
    assert completed(config, [])["sensor"]["rows"] == 8
    with pytest.raises(InputError, match="sensor.rows is 16 here, but 8 in"):
        completed(config, ["sensor.rows=16"])


def test_pairs_can_be_those_of_another_flow(parent: Path, tmp_path: Path):
    def on_pairs_of(flow: Path | None) -> dict:
        data = {"name": "pairs", "root": None, "pairs": {"of": flow and str(flow)}}
        return completed(
            {
                **child(parent, False),
                "data": data,
                "stage": {"name": "reflow", "parent": str(parent)},
            },
            [],
        )

    other = write_checkpoint(tmp_path / "other" / "flow.ckpt", {**CONFIG, "seed": 1})
    config = on_pairs_of(other)
    its_own = config["stage"]["parent"]
    assert (
        config["data"]["pairs"]["parent"]
        == weights_hash(load_checkpoint(other))
        != its_own["weights"]
    )
    assert Path(config["data"]["root"]).parent == other.parent
    own = on_pairs_of(None)
    assert own["data"]["pairs"]["parent"] == own["stage"]["parent"]["weights"] == its_own["weights"]
    assert Path(own["data"]["root"]).parent == Path(its_own["path"]).parent == parent.parent
    with pytest.raises(
        InputError, match=r"data\.pairs\.of=.*taller\.ckpt has another sensor than .*parent\.ckpt"
    ):
        on_pairs_of(write_checkpoint(tmp_path / "taller.ckpt", sized(CONFIG, 16, 64)))


@pytest.mark.parametrize("position", ["none", "polar", "spherical_harmonics"])
def test_weights_move_to_another_size_where_none_belongs_to_a_place(position: str):
    theirs, ours = (
        build_generator(sized(CONFIG, *size, position=position)) for size in ((8, 64), (16, 128))
    )
    with torch.no_grad():
        for value in theirs.parameters():
            value.normal_()
    rays = ours.backbone.coords.clone()
    ours.start_from(theirs)
    there = dict(theirs.named_parameters())
    assert all(torch.equal(value, there[name]) for name, value in ours.named_parameters())
    assert torch.equal(ours.backbone.coords, rays)
    # A network made for the size, with these weights, does the same: nothing of the old rays is
    # left.
    same = build_generator(sized(CONFIG, 16, 128, position=position))
    same.load_state_dict({**theirs.state_dict(), "backbone.coords": rays})
    x, t = torch.randn(1, 1, 16, 128), torch.tensor(0.3)
    with torch.no_grad():
        assert torch.equal(ours.velocity(t, x), same.velocity(t, x))


def test_weights_that_belong_to_a_place_do_not_move():
    theirs, ours = (
        build_generator(sized(CONFIG, *size, position="learnable")) for size in ((8, 64), (16, 128))
    )
    with pytest.raises(InputError, match=r"do not fit .*give the sensor .*size mismatch"):
        ours.start_from(theirs)


SENSOR_012 = replace(SENSOR, reflectance_scale=0.012)


def data_options(**options: Any) -> DataOptions:
    return construct("data", DataOptions, options)


@pytest.mark.parametrize(
    ("name", "root", "given", "expected"),
    [
        ("folder", "scans", None, 0.012),
        ("folder", "scans", 255.0, 255.0),
        ("folder", "drawn", None, 1.0),
        ("folder", "drawn", 255.0, 1.0),
        ("kitti_raw", "scans", None, 1.0),
        ("nuscenes", "scans", None, 255.0),
    ],
)
def test_full_reflectance_is_what_was_given_else_the_sensors_and_one_in_what_r2flow_wrote(
    tmp_path: Path, name, root, given, expected
):
    Store(tmp_path / "drawn", "samples", {}).begin()
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "manifest.json").write_text('{"version": 1}')  # of a data set
    data = data_options(name=name, root=str(tmp_path / root), reading={"reflectance_scale": given})
    (one,) = plan_data(data, SENSOR_012).sets
    assert one.options.reading.reflectance_scale == expected


def test_each_set_of_scans_says_its_whole_reading():
    part = {"name": "folder", "root": "a"}
    other = {"name": "folder", "root": "b", "reading": {"reflectance_scale": 2.0}}
    data = {"name": "mixed", "parts": [part, other], "validation": {"data": part, "scans": 4}}
    reading = {"convention": "reference", "columns": None}
    found = ScanDataModule(**data, reading=reading, sensor=SENSOR_012).described()
    scales = [
        one["reading"]["reflectance_scale"]
        for one in (*found["parts"], found["validation"]["data"])
    ]
    assert scales == [0.012, 2.0, 0.012]
    for one in (*found["parts"], found["validation"]["data"]):
        whole = {
            "projection": "spherical",
            "convention": "reference",
            "columns": None,
            "on_bad_scan": "error",
            "label_ids": None,
        }
        assert one["reading"] == {**whole, "reflectance_scale": one["reading"]["reflectance_scale"]}
    assert ScanDataModule(**found).described() == found  # a run that is resumed says the same
    reading = {"projection": "unfolding", "reflectance_scale": 2.0}
    beside = plan_data(data_options(name="pairs", scans=part, reading=reading), SENSOR_012).scans
    scans = beside.options.reading
    assert (scans.projection, scans.reflectance_scale) == ("unfolding", 0.012)


def parent_of(reading: dict, path: Path) -> Parent:
    there = find_parent(path)
    data = {"name": "folder", "reading": reading}
    return replace(there, config=ModelConfig({**there.config.stored, "data": data}))


def test_scans_in_files_become_the_images_that_the_parent_has_learned(parent: Path):
    there = parent_of({"projection": "unfolding", "convention": "reference"}, parent)
    config = {**child(parent, False), "data": {"name": "folder", "root": "scans"}}

    def found(**data) -> tuple[str, str]:
        found = completed({**config, "data": {**config["data"], **data}}, [], there)["data"]
        for one in found["parts"] or [found]:
            return one["reading"]["projection"], one["reading"]["convention"]

    assert found() == ("unfolding", "reference")
    assert found(reading={"projection": "spherical"}) == ("spherical", "reference")
    assert found(name="mixed", root=None, parts=[{"name": "folder", "root": "scans"}]) == (
        "unfolding",
        "reference",
    )
    for name, parts in (("simulated", None), ("mixed", [{"name": "simulated"}])):
        assert found(name=name, root=None, parts=parts) == ("spherical", "centre")


def test_pairs_are_read_as_the_flow_that_draws_them_says(parent: Path):
    read = {"projection": "unfolding", "convention": "reference", "reflectance_scale": 255.0}
    data = {
        "name": "pairs",
        "root": None,
        "pairs": {},
        "reading": {**dict.fromkeys(read), "projection": "spherical"},
    }
    config = {
        **child(parent, False),
        "data": data,
        "stage": {"name": "reflow", "parent": str(parent)},
    }
    there = parent_of(read, parent)
    assert {key: completed(config, [], there)["data"]["reading"][key] for key in read} == read
    with pytest.raises(InputError, match="data.reading is that of the flow that draws the pairs"):
        completed(config, ["data.reading.projection"], there)
