"""r2flow complete: as a user types it."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import r2flow
from r2flow.base.errors import InputError
from r2flow.base.noise import generator
from r2flow.data.opening import open_scans
from r2flow.data.partial import open_partial
from r2flow.data.reading import Reading
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import Ray, parse_mask
from r2flow.lidar.other_sensors import Partial, image_through
from r2flow.lidar.projection import image_to_points, project
from r2flow.lidar.scan_files import read_points, write_points
from r2flow.lidar.sensors import SENSORS, write_sensor
from r2flow.model import checkpoint
from r2flow.reports import answers
from r2flow.reports.answer_counts import more_rows
from r2flow.reports.answer_errors import compared, in_words
from r2flow.simulator import simulate
from tests.conftest import SENSOR, Done, prepare_folder, write_run
from tests.test_completion import network
from tests.test_sampling import scans

VLP16 = SENSORS["vlp16"]
TRANSFER = {"name": "transfer"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("complete") / "run", network(), TRANSFER)


@pytest.fixture
def complete(r2flow, run, tmp_path):
    """`r2flow complete`, by the run and into the folder `out` if not told otherwise."""

    def typed(*arguments: object, model: Path | None = run, out: Path = tmp_path / "out") -> Done:
        by = () if model is None else ("-c", model)
        return r2flow("complete", "--pictures", 0, *arguments, *by, "--out", out)

    return typed


def assert_refused(answer: Done, message: str, out: Path) -> None:
    assert message in answer.refusal
    assert not out.exists()


def full_scan(path: Path, number: int = 0) -> np.ndarray:
    """A scan of the model's own sensor, as a file of the path's format; its image."""
    image = scans(2)[number].numpy()
    if path.suffix == ".npy":
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, image)
    else:
        write_points(path, *image_to_points(image, SENSOR.rays()))
    return image


def sparse_scan(path: Path, steps: int = 900) -> np.ndarray:
    e = np.deg2rad(np.asarray(VLP16.elevations) + 0.1)[None]
    a = np.linspace(-np.pi, np.pi, steps, endpoint=False)[:, None]
    e, a = np.broadcast_arrays(e, a)
    xyz = np.stack([9 * np.cos(a), 9 * np.sin(a), 9 * np.tan(e)], -1).reshape(-1, 3)
    write_points(path, xyz)
    return xyz


def test_errors_at_hidden_rays_stand_beside_the_best_interpolation(r2flow, run, tmp_path):
    """In the terminal, in compare.json and on the page; of an answer that is read again."""
    image = full_scan(tmp_path / "one.npy")
    given = tmp_path / "one.npy", "-c", run, "--mask=rows:2"
    said = r2flow("complete", *given, "--out", tmp_path / "out").said
    answer = np.load(tmp_path / "out" / "one.npy")
    hidden = np.arange(8)[:, None] % 2 == np.ones(64)
    known = [
        interpolated(image * ~hidden, ~hidden, rule) for rule in ("nearest", "linear", "inverse")
    ]
    common = hidden & (image[0] > 0) & np.all([one[0] > 0 for one in (answer, *known)], axis=0)
    off = [abs(image[0] - one[0])[common].mean() for one in (answer, *known)]
    line = f"mean error {off[0]:.3f} m, best interpolation ({{}}) {min(off[1:]):.3f} m"
    named = ("nearest", "linear", "linear, 1/r")[int(np.argmin(off[1:]))]
    assert line.format(named) in said
    assert line.format(named) in (tmp_path / "out" / "one.html").read_text()
    noted = json.loads((tmp_path / "out" / "compare.json").read_text())["one"]
    assert noted["answer"]["mae_common_m"] == pytest.approx(off[0], rel=1e-5)
    wrong = ((answer[0] > 0) != (image[0] > 0))[hidden].mean()
    assert noted["answer"]["drop_wrong"] == pytest.approx(wrong)
    assert f"; wrong in ray-drop {wrong:.1%}, " in said


def test_points_left_out_by_their_errors_are_not_wrong_in_ray_drop():
    image = scans(1)[0].numpy()
    kept = np.arange(8)[:, None] % 2 == np.zeros(64)
    state = np.where(image[0] > 0, Ray.RETURN, Ray.EMPTY)
    answer = torch.from_numpy(image * (kept | (image[0] < 9)))[None]  # far points are left out
    completed = SimpleNamespace(images=answer)
    known = Partial(image * kept, np.where(kept, state, Ray.UNKNOWN))
    given = Partial(image, state), SimpleNamespace(known=known, completed=completed), SENSOR
    wrong = (image[0] >= 9)[~kept].mean()
    assert 0 < wrong < 1
    assert f"; wrong in ray-drop {wrong:.1%}, " in in_words([compared(*given)])
    found = compared(*given, max_error=0.2)
    assert "ray-drop" not in in_words([found])
    assert math.isnan(found.errors["drop_wrong"])
    assert found.errors["mae_common_m"] == 0


@pytest.mark.parametrize("ending", [".bin", ".npy"])
def test_a_masked_scan_is_completed_in_its_own_format(r2flow, run, tmp_path, ending):
    image = full_scan(tmp_path / f"one{ending}")
    found = tmp_path / "out" / f"one{ending}"
    assert r2flow(
        "complete", tmp_path / found.name, "-c", run, "--mask=rows:2", "--out", found.parent
    ).quiet
    if ending == ".npy":
        answer = np.load(found)
        assert np.array_equal(answer[:, ::2], image[:, ::2])
        assert (answer[0, 1::2] > 0).any()
    else:
        given, answered = (read_points(path) for path in (tmp_path / f"one{ending}", found))
        kept = project(given.xyz, given.reflectance, SENSOR)[0][::2]
        known = np.isin(np.linalg.norm(given.xyz, axis=1).astype(np.float32), kept[kept > 0])
        assert known.sum() > 100
        both = {*map(tuple, given.xyz)} & {*map(tuple, answered.xyz)}
        assert both == {*map(tuple, given.xyz[known])}  # to the bit, and nothing hidden
        assert both == {*map(tuple, answered.xyz[: known.sum()])}  # before the new points
    assert (tmp_path / "out" / "one.png").stat().st_size > 10_000
    assert "your scan" in (tmp_path / "out" / "one.html").read_text()


def test_a_sparser_sensor_is_found_and_its_points_come_back(complete, tmp_path):
    xyz = sparse_scan(tmp_path / "in" / "room.PCD")
    said = complete(tmp_path / "in", "--num", 2).said
    for words in (
        "vlp16 with 16 beams from +15.1 to -14.9",
        "6 of the 8 rows",
        "7 of its 16 beams look past",
    ):
        assert words in said
    assert "uses them with densify" in said  # the model itself has no other sensor
    answers = [read_points(tmp_path / "out" / f"room_{a}.pcd") for a in range(2)]
    for answer in answers:
        assert np.array_equal(answer.xyz[: len(xyz)], xyz.astype(np.float32))
        assert len(answer.xyz) <= len(xyz) + 2 * 64  # six of the eight rows are measured
        assert answer.reflectance is None  # the scan has none
    with np.load(tmp_path / "out" / "room.spread.npz") as spread:
        assert spread["deviation"].shape == spread["returned"].shape == (8, 64)
        assert ((spread["deviation"] == 0) & (spread["returned"] == 1)).sum() >= 6 * 64
    assert len(open_scans(tmp_path / "out")) == 2  # the answers alone, not their spread
    assert (
        "vlp16 with 16 beams"
        in complete(tmp_path / "in", "--from", "vlp16", out=tmp_path / "named")[1]
    )


def test_finished_scans_are_passed_over_and_the_others_come_out_the_same(complete, tmp_path):
    for number, name in enumerate(("one.npy", "two.npy")):
        full_scan(tmp_path / "in" / name, number)
    asked = [tmp_path / "in", "--mask", "points:0.3", "--seed", 3]
    assert "2 scans written" in complete(*asked)[1]
    first = {path.name: path.read_bytes() for path in (tmp_path / "out").glob("*.npy")}
    (tmp_path / "out" / "two.npy").unlink()
    stamp = (tmp_path / "out" / "one.npy").stat().st_mtime_ns
    assert "1 scan written" in (said := complete(*asked)[1])
    assert "1 there already" in said
    assert (tmp_path / "out" / "one.npy").stat().st_mtime_ns == stamp
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").glob("*.npy")} == first
    assert "holds other answers: " in complete(*asked, "--num", 3).refusal
    kept = parse_mask("points:0.3")(np.ones((8, 64), bool), generator(3, "condition", 1))
    image, answer = np.load(tmp_path / "in" / "two.npy"), np.load(tmp_path / "out" / "two.npy")
    assert np.array_equal(image[:, kept], answer[:, kept])


def test_a_scan_that_fills_the_image_is_told_what_adds_points(complete, tmp_path):
    """The options that are named add as many rows as there are beams."""
    xyz = sparse_scan(tmp_path / "room.pcd", steps=200)
    given = tmp_path / "room.pcd", "--from", "vlp16", "--to", "vlp16"
    said = complete(*given, "--size", "16x64").said
    named = "--to vlp16 --size 32x64"
    assert f"room: hardly a new point, as the scan fills all 16x64 rays; {named} has rows" in said
    assert said.endswith(", 0 new points a scan\n")
    assert "hardly" not in complete(*given[:3], *named.split(), out=tmp_path / "more").said
    assert len(xyz) + 500 < len(read_points(tmp_path / "more" / "room.pcd").xyz) <= len(xyz) + 1024
    assert more_rows(VLP16, own=False, image=True) == "--from vlp16 --size 32x1024"
    assert more_rows(replace(VLP16, name="mine"), own=True).startswith("--to FILE (r2flow sensor")


def test_the_gaps_of_a_thinned_scan_are_filled_where_asked(complete, tmp_path):
    """Returns come back to the bit and some gaps return; without the option all gaps are rays
    without a return.
    """
    image = full_scan(tmp_path / "one.npy")
    image[:, ::2, ::3] = 0
    np.save(tmp_path / "one.npy", image)
    assert complete(tmp_path / "one.npy", "--fill-gaps")[0] == 0
    filled = np.load(tmp_path / "out" / "one.npy")
    there = image[0] > 0
    assert np.array_equal(filled[:, there], image[:, there])
    assert (filled[0][~there] > 0).any()
    assert "fill_gaps" in complete(tmp_path / "one.npy").refusal
    xyz = sparse_scan(tmp_path / "room.ply")
    write_points(tmp_path / "thin.ply", xyz[np.random.default_rng(0).random(len(xyz)) < 0.02])
    for name, thinned in ("room", False), ("thin", True):
        said = complete(tmp_path / f"{name}.ply", "--from", "vlp16", out=tmp_path / name).said
        assert (
            "of the measured rays have no return: for thinned scans give --fill-gaps" in said
        ) == thinned


def test_simulated_scans_are_seen_through_another_sensor(complete, tmp_path):
    said = complete("simulated:3", "--from", "vlp16", "--scans", 1, "--steps", 1).said
    assert "simulated:3: vlp16 with 16 beams" in said
    assert np.load(tmp_path / "out" / "simulated-3-000000.npy").shape == (2, 8, 64)


@pytest.mark.parametrize("ending", [".csv", ".bin", ".npy"])
def test_a_scan_without_reflectance_gets_none(complete, tmp_path, ending: str):
    path = tmp_path / "in" / f"one{ending}"
    path.parent.mkdir()
    image = scans(1)[0, :1].numpy()
    xyz, nothing = image_to_points(image, SENSOR.rays())
    if ending == ".csv":
        np.savetxt(path, xyz, delimiter=",", header="x,y,z", comments="")
    elif ending == ".bin":  # it has the column
        write_points(path, xyz, nothing)
    else:
        np.save(path, image)
    last = complete(path, "--mask", "rows:2").said.splitlines()[-1]
    assert " new points a scan" in last
    if ending == ".npy":
        assert np.load(tmp_path / "out" / "one.npy").shape == image.shape
        return
    found = read_points(tmp_path / "out" / path.name)
    assert (found.reflectance is None) == (ending == ".csv")
    assert ending == ".csv" or not found.reflectance.any()


def test_a_model_of_range_alone_leaves_reflectance_out(complete, tmp_path):
    path = write_run(tmp_path / "run", network(reflectance=False), TRANSFER)
    full_scan(tmp_path / "one.bin")
    assert (
        "answers have no reflectance"
        in complete(tmp_path / "one.bin", "--mask", "rows:2", model=path).said
    )
    answer = read_points(tmp_path / "out" / "one.bin").reflectance
    assert answer.any()
    with np.load(tmp_path / "out" / "one.fields.npz") as fields:
        assert not answer[fields["measured"] == 0].any()


def test_a_diffusion_completes_by_its_own_repaint(complete, tmp_path):
    path = write_run(tmp_path / "run", network("diffusion"), TRANSFER)
    image = full_scan(tmp_path / "one.npy")
    assert complete(
        tmp_path / "one.npy", "--mask", "rows:2", "--sampler", "repaint", "--steps", 2, model=path
    ).quiet
    assert np.array_equal(np.load(tmp_path / "out" / "one.npy")[:, ::2], image[:, ::2])
    note = json.loads((tmp_path / "out" / "manifest.json").read_text())["recipe"]["sampler"]
    assert (note["name"], note["steps"], note["repeats"]) == ("repaint", 2, 16)


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        (None, ["--mask", "points:0"], "one: the mask keeps nothing that was measured"),
        (None, ["--mask", "points:1"], "one: the mask keeps everything that was measured"),
        (
            None,
            ["--from", "vlp16"],
            "of 8 rows by --from, in Python by sensor (vlp16 has 16), or --size 8x64 alone",
        ),
        (
            np.full((2, 8, 64), np.nan, np.float32),
            [],
            "is NaN or infinite in places; 0 stands for a ray without",
        ),
        (
            np.full((1, 8, 4), 3, np.float32),
            [],
            "must be a range image of floats (2 or 1, H, W), found float32 (1, 8",
        ),
        (-scans()[0].numpy(), [], "Are these millimetres, or a scan in model space?"),
        (np.full((2, 8, 64), 3, np.float32), [], "its reflectance goes up to 3, not 1; divide"),
        (np.full((1, 8, 64), 90, np.float32), [], "none of its ranges lies within 1.45-80 m"),
    ],
)
def test_what_cannot_be_done_is_one_line(complete, tmp_path, image, options, message):
    np.save(tmp_path / "one.npy", scans()[0].numpy() if image is None else image)
    assert_refused(complete(tmp_path / "one.npy", *options), message, tmp_path / "out")


def test_a_run_completes_a_recording_with_the_options_of_scans(complete, r2flow, tmp_path):
    """By its sampler the run predicts no errors."""
    pytest.importorskip("rosbags")
    sparse_scan(tmp_path / "in" / "0.pcd", steps=200)
    drive, dense = tmp_path / "drive.mcap", tmp_path / "dense.mcap"
    assert r2flow("pack", tmp_path / "in", "--rate", 10, "--out", drive).quiet
    options = ["--to", "vlp16", "--size", "32x64"]
    refusal = complete(drive, *options, "--max-error", 1, out=dense).refusal
    assert "error: this model predicts no errors: leave max_error out" in refusal
    assert not dense.exists()
    wrong = complete(drive, "--from", "hdl64e", out=dense)
    assert wrong.said.startswith(f"{dense}: 1 of 1 clouds of /points completed")
    assert f"{drive}: sensor hdl64e does not fit these scans" in wrong.stderr
    own = "--from", "vlp16", "--to", "vlp16", "--size", "16x64"
    said = complete(drive, *own, out=tmp_path / "own.mcap").said
    assert said.endswith("0 new points a cloud\nhardly a new point: see --to vlp16 --size 32x64\n")


def test_two_fields_of_one_name_are_found_before_the_model_runs(complete, tmp_path):
    twice = tmp_path / "twice.csv"
    twice.write_text("x,y,z,_,_,stamp,stamp\n" + "1,2,3,0,1,2,3\n" * 9)
    message = f"error: {twice}: it has two fields of the name stamp: rename one."
    assert_refused(complete(twice), message, tmp_path / "out")


def test_minus_one_is_no_return_at_any_share(complete, tmp_path):
    image = full_scan(tmp_path / "zeros.npy")
    image[:, ::4] = 0
    image[:, :, ::3] = 0
    np.save(tmp_path / "zeros.npy", image)
    np.save(tmp_path / "ones.npy", np.where(image[0] == 0, -1, image))
    assert np.mean(image[0] == 0) > 0.5
    options = "--steps", 2, "--mask", "rows:2"
    for name in ("zeros", "ones"):
        assert complete(tmp_path / f"{name}.npy", *options, out=tmp_path / name).said
    completed = [np.load(tmp_path / name / f"{name}.npy") for name in ("zeros", "ones")]
    np.testing.assert_array_equal(*completed)


@pytest.mark.parametrize("sensor", [[], ["--from", "vlp32c"]])
def test_points_of_which_none_is_in_view_are_one_line(complete, tmp_path, sensor):
    xyz, reflectance = image_to_points(scans()[0].numpy(), SENSOR.rays())
    write_points(
        tmp_path / "far.bin", 500 * xyz / np.linalg.norm(xyz, axis=1, keepdims=True), reflectance
    )
    assert_refused(
        complete(tmp_path / "far.bin", *sensor), "lies within 1.45-80 m", tmp_path / "out"
    )


def test_the_folder_of_the_scans_is_not_written_into(complete, tmp_path):
    """There the note on the answers would be taken for one on the scans."""
    sparse_scan(tmp_path / "in" / "room.pcd")
    for what in (tmp_path / "in" / "room.pcd", tmp_path / "in", tmp_path):
        out = tmp_path if what == tmp_path else tmp_path / "in"
        assert f"{out} is the folder of the scans" in complete(what, "--num", 2, out=out).refusal
    assert [path.name for path in (tmp_path / "in").iterdir()] == ["room.pcd"]


@pytest.mark.parametrize("ending", [".npy", ".bin"])
def test_answers_to_another_scan_of_the_same_name_are_none(complete, tmp_path, ending, monkeypatch):
    for number, drive in enumerate("ab"):
        full_scan(tmp_path / drive / f"one{ending}", number)
    asked = "--mask", "rows:2"
    full_scan(tmp_path / "out" / f"one{ending}", 1)
    assert complete(tmp_path / "a", *asked)[0] == 2
    (tmp_path / "out" / f"one{ending}").unlink()
    assert complete(tmp_path / "a", *asked)[0] == 0
    before = (tmp_path / "out" / f"one{ending}").read_bytes()
    assert "another scan of the name one" in complete(tmp_path / "b", *asked).refusal
    assert (tmp_path / "out" / f"one{ending}").read_bytes() == before
    full_scan(tmp_path / "b" / f"two{ending}", 0)
    (tmp_path / "b" / f"one{ending}").unlink()
    assert "1 scan written" in complete(tmp_path / "b", *asked)[1]
    answer, both, last = answers.complete, tmp_path / "both", tmp_path / "last"
    # a command that begins and ends meanwhile
    other = [lambda: complete(tmp_path / "b", *asked, out=both)]
    monkeypatch.setattr(
        answers, "complete", lambda *a, **how: (other and other.pop()(), answer(*a, **how))[1]
    )
    assert [complete(tmp_path / drive, *asked, out=both)[0] for drive in "aab"] == [0, 0, 0]
    other = [lambda: complete(tmp_path / "b", *asked, out=last)]
    assert (
        "holds other answers: seed"
        in complete(tmp_path / "a", *asked, "--seed", 1, out=last).refusal
    )
    # for writing: complete folders may be read-only
    monkeypatch.setattr("os.access", lambda _, mode: not mode & 2)
    assert complete(tmp_path / "a", *asked, out=both)[0] == 0


def test_prepared_scans_are_named_by_their_numbers_in_the_set(complete, tmp_path, monkeypatch):
    # no pause
    monkeypatch.setattr(
        "r2flow.base.progress.Bar.__init__.__defaults__", ("scans", None, False, 0, 0.0)
    )
    for place, number in enumerate([0, 1, 0, 1]):
        full_scan(tmp_path / "scans" / f"{place}.npy", number)
    given = prepare_folder(tmp_path / "scans", tmp_path / "prep", SENSOR)
    asked = given, "--mask", "rows:2", "--scans"
    for most, numbers in ((1, [2]), (2, [1, 2, 3])):  # evenly spread
        assert complete(*asked, most)[0] == 0
        assert sorted(path.stem for path in (tmp_path / "out").glob("*.npy")) == [
            f"prep-{n:06d}" for n in numbers
        ]
    whole = open_scans(given).source
    for number in numbers:
        assert np.array_equal(
            np.load(tmp_path / "out" / f"prep-{number:06d}.npy")[:, ::2], whole[number][:, ::2]
        )
    assert f"1 scan written to {tmp_path / 'out'}, 3 there already" in complete(*asked, 4).said
    assert "hashing 4/4 scans" in complete(*asked, 4).stderr


def test_a_bad_scan_may_be_mended_and_the_command_given_again(complete, tmp_path):
    full_scan(tmp_path / "in" / "a.npy", 0)
    image = full_scan(tmp_path / "in" / "b.npy", 1)
    np.save(tmp_path / "in" / "b.npy", np.where(image == image.max(), np.nan, image))
    asked = tmp_path / "in", "--mask", "rows:2"
    assert complete(*asked)[0] == 2
    np.save(tmp_path / "in" / "b.npy", image)
    assert "1 scan written" in complete(*asked).said


def test_an_unusual_scale_that_is_estimated_is_told(complete, tmp_path):
    xyz = sparse_scan(tmp_path / "one.ply")
    write_points(tmp_path / "one.ply", xyz, np.linspace(0, 0.01, len(xyz), dtype=np.float32))
    asked = tmp_path / "one.ply", "--from", "vlp16"
    assert "reflectance is divided by 0.01; --reflectance-scale" in complete(*asked)[2]
    assert complete(*asked, "--reflectance-scale", "0.01", out=tmp_path / "b")[2] == ""
    # So is that of a scan of the model's sensor: unscaled values would stand next to answers in [0,
    # 1].
    full_scan(tmp_path / "two.bin")
    points = read_points(tmp_path / "two.bin")
    write_points(
        tmp_path / "two.bin",
        points.xyz,
        points.reflectance / points.reflectance.max() * np.float32(0.02),
    )
    assert (
        "divided by 0.02"
        in complete(tmp_path / "two.bin", "--mask", "rows:2", out=tmp_path / "c")[2]
    )
    # in the unit of the file
    assert read_points(tmp_path / "c" / "two.bin").reflectance.max() == pytest.approx(0.02)


@pytest.mark.parametrize("size", ["32x128", "16x128"])
def test_reflectance_beyond_the_sensor_s_scale_is_neither_clipped_nor_silent(
    complete, tmp_path, size
):
    xyz = sparse_scan(tmp_path / "room.pcd")
    # 0 to 255, in two bytes
    counts = np.resize(np.arange(0, 65536, 257, dtype=np.float32), len(xyz))
    write_points(tmp_path / "room.pcd", xyz, counts)
    write_sensor(replace(VLP16, name="mine", reflectance_scale=255.0), tmp_path / "mine.yaml", "")
    given = (
        "--from",
        tmp_path / "mine.yaml",
        "--to",
        tmp_path / "mine.yaml",
        "--size",
        size,
        "--fill-gaps",
    )
    code, _, error = complete(tmp_path / "room.pcd", *given, model=None)
    assert (code, error.count("divided by 65535")) == (0, 1)
    answer = read_points(tmp_path / "out" / "room.pcd").reflectance
    np.testing.assert_array_equal(answer[: len(xyz)], counts)
    counts = np.minimum(counts, 200)
    counts[0] = 210  # a single value beyond the named scale
    write_points(tmp_path / "room.pcd", xyz, counts)
    write_sensor(replace(VLP16, name="mine", reflectance_scale=200.0), tmp_path / "mine.yaml", "")
    assert (
        "divided by"
        not in complete(tmp_path / "room.pcd", *given, model=None, out=tmp_path / "named")[2]
    )
    answer = read_points(tmp_path / "named" / "room.pcd").reflectance
    np.testing.assert_array_equal(answer[: len(xyz)], counts)


def test_points_that_are_dropped_are_told(complete, tmp_path):
    full_scan(tmp_path / "one.bin")
    rows = np.fromfile(tmp_path / "one.bin", np.float32).reshape(-1, 4)
    rows[::5, 3] = np.nan
    rows.tofile(tmp_path / "one.bin")
    assert (
        f"are dropped ({len(rows[::5])} points"
        in complete(tmp_path / "one.bin", "--mask", "rows:2")[2]
    )


def test_answers_by_another_mask_file_or_scale_are_none(complete, tmp_path):
    full_scan(tmp_path / "one.bin")
    mask = np.arange(8)[:, None] % 2 == np.zeros(64)
    np.save(tmp_path / "mask.npy", mask)
    asked = tmp_path / "one.bin", "--mask", tmp_path / "mask.npy"
    assert complete(*asked)[0] == 0
    assert "1 there already" in complete(*asked)[1]
    assert "reflectance_scale=None there, 2.0 here" in complete(*asked, "--reflectance-scale", 2)[2]
    np.save(tmp_path / "mask.npy", ~mask)
    assert "mask=" in complete(*asked).refusal


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scan", "beams"),
    [
        ("vlp16/000200.pcd", "16 beams"),
        (
            "nuscenes_hdl32e/n015-2018-07-24-11-22-45+0800__LIDAR_TOP__1532402927647951.pcd.bin",
            "32 beams",
        ),
        ("rellis_os1_64/000104.bin", "64 beams"),
        ("rellis_vlp32c/vel000104.bin", "32 beams"),
    ],
)
def test_real_scans_of_other_sensors_are_completed(complete, run, shared, tmp_path, scan, beams):
    file = shared / "real" / "other_sensors" / scan
    said = complete(file).said
    assert beams in said
    assert "1 scan written" in said
    assert " as ." not in said  # another format
    used, kept = (
        int(number.replace(",", ""))
        for number in re.findall(r"(?:used|kept):[ a-z]* (\d[\d,]*)\b", said)
    )
    flow, (written,) = (
        r2flow.load(run),
        (file for file in (tmp_path / "out").iterdir() if file.suffix != ".json"),
    )
    answer, points, given = flow.complete(file), read_points(file), read_points(written)
    assert len(flow.points(answer[0])[0]) - used == len(given.xyz) - kept >= 0
    r = np.linalg.norm(points.xyz, axis=1)
    assert np.array_equal(
        given.xyz[:kept], points.xyz[(r >= SENSOR.min_range) & (r <= SENSOR.max_range)]
    )
    if points.reflectance is not None:
        assert torch.equal(flow.complete(np.column_stack([points.xyz, points.reflectance])), answer)


def test_densify_keeps_all_beams_by_default(complete, tmp_path):
    """The model's own view, from +3 to -25 degrees, has 10 of a VLP-16's 16 beams."""
    sparse_scan(tmp_path / "room.pcd", steps=200)
    said = complete(tmp_path / "room.pcd", model=None).said
    assert "16 of the 64 rows to complete are measured" in said
    assert "in their own view, as 64x1024, which keeps all their beams" in said
    answer = read_points(tmp_path / "out" / "room.pcd").xyz
    elevation = np.degrees(np.arcsin(answer[:, 2] / np.linalg.norm(answer, axis=1)))
    assert elevation.max() > 14
    assert elevation.min() < -14


def test_fewer_beams_than_rows_of_a_sensor_of_ones_own_are_found(complete, tmp_path):
    sparse_scan(tmp_path / "room.pcd")
    write_sensor(replace(VLP16, name="mine"), tmp_path / "mine.yaml", "")
    asked = tmp_path / "room.pcd", "--to", tmp_path / "mine.yaml", "--size", "32x128"
    assert "16 of the 32 rows to complete are measured" in complete(*asked, model=None).said
    said = complete(*asked[:1], "--from", tmp_path / "mine.yaml", out=tmp_path / "other").said
    assert "6 of its 16 beams look past" in said
    assert (
        "--to FILE (r2flow sensor) --size 16x900, in Python Checkpoint.through of such a sensor, uses"
        in said
    )


def test_points_in_memory_are_named_in_a_refusal_and_in_a_warning(run, tmp_path, caplog):
    xyz = sparse_scan(tmp_path / "room.ply")
    cloud = np.column_stack([xyz, np.linspace(0, 0.05, len(xyz))])
    same = cloud, cloud[::-1].astype(">f8")[::-1], torch.from_numpy(cloud).requires_grad_()
    answers = torch.stack([r2flow.load(run).complete(points, sensor="vlp16") for points in same])
    assert torch.equal(answers, answers[:1].expand_as(answers))
    assert torch.equal(*(r2flow.load(run).complete(cloud, sensor="hdl64e") for _ in range(2)))
    assert [message.partition(":")[0] for message in caplog.messages] == ["points in memory"] * 2
    coarse = torch.from_numpy(cloud).bfloat16()
    assert torch.equal(
        *(r2flow.load(run).complete(points, sensor="vlp16") for points in (coarse, coarse.double()))
    )
    for given, found in (
        (np.zeros(4), "(4,)"),
        (np.zeros((0, 2, 8, 64)), "(0, 2, 8, 64)"),
        (["a.bin"], "list"),
    ):
        with pytest.raises(InputError, match=rf"points \(N, 3 or 4\); found .*{re.escape(found)}"):
            r2flow.load(run).complete(given)
    with pytest.raises(
        InputError, match="^points in memory: .*, in Python by sensor: .*beams cannot be separated"
    ):
        r2flow.load(run).complete(np.random.default_rng(0).normal(size=(1000, 3)))


def test_a_named_sensor_of_points_in_memory_is_found_once_in_a_loop(run, tmp_path, monkeypatch):
    points, found = sparse_scan(tmp_path / "room.ply"), []
    see = checkpoint.sight
    monkeypatch.setattr(
        checkpoint, "sight", lambda *given, **how: found.append(1) or see(*given, **how)
    )
    flow = r2flow.load(run)
    one, other = (flow.complete(points, sensor="vlp16") for _ in range(2))
    assert torch.equal(one, other)
    assert len(found) == 1
    flow.complete(points[::2], sensor="vlp16")  # another number of rays a turn
    assert len(found) == 2


def test_a_wrong_sensor_of_the_scans_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    sparse_scan(tmp_path / "0.ply")
    open_partial([str(tmp_path)], Reading(VLP16), VLP16)
    assert not caplog.text
    open_partial([str(tmp_path)], Reading(VLP16), SENSORS["os1_64"])
    assert all(words in caplog.text for words in ("sensor os1_64 does not fit", "they fit vlp16"))


def test_points_of_a_pitched_vehicle_are_warned_of_and_completed(complete, tmp_path: Path):
    xyz, c, s = sparse_scan(tmp_path / "0.ply"), np.cos(np.radians(5)), np.sin(np.radians(5))
    assert complete(tmp_path / "0.ply", "--from", "vlp16").quiet
    write_points(tmp_path / "1.ply", xyz @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]))
    code, said, error = complete(tmp_path / "1.ply", "--from", "vlp16", out=tmp_path / "pitched")
    assert (code, error.count("\n"), "1 scan written" in said) == (0, 1, True), error
    assert "give scans of one sensor, in its own frame" in error


def test_points_next_to_range_images_are_completed(complete, r2flow, tmp_path: Path):
    folder = tmp_path / "in"
    assert r2flow(
        "simulate",
        "--num",
        1,
        "--sensor",
        "vlp16",
        "--format",
        "bin,npy",
        "--labels",
        "--out",
        folder,
    ).said
    assert len(open_scans(folder)) == 1
    assert "16: ring after ring" in r2flow("sensor", folder).said
    assert r2flow("show", folder, "--out", tmp_path / "seen").quiet
    assert complete(folder).said
    xyz, answer = (read_points(path / "000000.bin").xyz for path in (folder, tmp_path / "out"))
    inside = np.linalg.norm(xyz, axis=1)
    kept = xyz[(inside >= SENSOR.min_range) & (inside <= SENSOR.max_range)]
    assert np.array_equal(answer[: len(kept)], kept)


def test_points_outside_the_limits_are_told(complete, tmp_path: Path):
    xyz, asked = sparse_scan(tmp_path / "some.ply"), ("--to", "vlp16", "--size", "32x360")
    xyz[:300] /= 100  # 0.1 m away
    xyz[300] = 0  # a ray without return
    write_points(tmp_path / "some.ply", xyz)
    assert (
        "; 300 outside 0.5-100 m left out"
        in complete(tmp_path / "some.ply", *asked, model=None).said
    )


@pytest.mark.parametrize(
    ("rows", "columns", "named"), [(4, 64, True), (8, 32, True), (4, 32, True), (8, 32, False)]
)
def test_points_of_a_coarser_sensor_leave_as_much_open_as_its_image(tmp_path, rows, columns, named):
    """The same rays as points and as a range image: between them nothing was measured."""
    sensor, target = SENSORS["os1_64"].resized(rows, columns), SENSORS["os1_64"].resized(8, 64)
    # beams a little off the middle, where no row of the target ends
    sensor = replace(sensor, elevations=tuple(e + 0.2 for e in sensor.elevations))
    image = np.stack([np.full(sensor.shape, 9.0), np.full(sensor.shape, 0.5)]).astype(np.float32)
    image[:, :, 3::5] = 0
    write_points(tmp_path / "points" / "0.ply", *image_to_points(image, sensor.rays()))
    ((scan,), (said,)) = open_partial(
        [str(tmp_path / "points")], Reading(target), sensor if named else None
    )
    expected = image_through(image, sensor, target)
    found = scan.read()
    for ray in Ray:
        assert (
            abs(int((found.state == ray).sum()) - int((expected.state == ray).sum()))
            <= rows * columns // 50
        )
    assert ("32 rays a turn" in said) == (columns == 32)


@pytest.mark.parametrize(
    ("mask", "more", "model", "size"),
    [
        ("rows:4", (), "densify", "64x1024"),
        ("rows:2", ("--size", "32x256"), "densify", "32x256"),
        ("rows:2", ("--to", "vlp16", "--size", "16x128"), "densify", "16x128"),
        ("sector:-60,60", ("--steps", 1), "street", "32x256"),
        ("rows:4", ("--sampler", "replace", "--steps", 1), "street", "32x256"),
    ],
)
def test_the_model_is_chosen_by_what_is_missing(complete, tmp_path, mask, more, model, size):
    image = simulate(SENSORS["hdl64e"].resized(64, 512), 5, 0).image
    write_points(
        tmp_path / "one.ply", *image_to_points(image, SENSORS["hdl64e"].resized(64, 512).rays())
    )
    said = complete(
        tmp_path / "one.ply", "--from", "hdl64e", "--mask", mask, *more, model=None
    ).said
    assert f"the model {model}: " in said
    assert f"in each pixel of {size}" in said
    assert len(read_points(tmp_path / "out" / "one.ply").xyz) > 1000


def test_scans_for_two_models_are_refused_together(complete, tmp_path):
    sensor = SENSORS["hdl64e"].resized(64, 512)
    image = simulate(sensor, 5, 0).image
    for name, kept in (("cut", np.s_[:, :, 300:]), ("thin", np.s_[:, ::4])):
        part = np.zeros_like(image)
        part[kept] = image[kept]
        write_points(tmp_path / "in" / f"{name}.ply", *image_to_points(part, sensor.rays()))
    asked = "--from", "hdl64e", "--fill-gaps"
    said = "cut lacks whole sectors (--checkpoint street) and thin does not (--checkpoint densify)"
    assert_refused(complete(tmp_path / "in", *asked, model=None), said, tmp_path / "out")
    assert complete(tmp_path / "in" / "cut.ply", *asked, "--steps", 1, model=None)[0] == 0
