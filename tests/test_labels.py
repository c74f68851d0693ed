"""Labels as channels: encoded, trained, drawn, written, painted and judged."""

import json
import math
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb

from r2flow.base.errors import InputError
from r2flow.base.noise import generator as draws
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading, read_image
from r2flow.generators import TransferFlow, build_generator, condition_of
from r2flow.lidar.encoding import Encoding, build_space
from r2flow.lidar.known import Ray, ray_states
from r2flow.lidar.labels import CLASSES, COMMON, common_classes, semantic_ids, write_labels
from r2flow.lidar.projection import image_points
from r2flow.lidar.scan_files import read_points, write_points
from r2flow.metrics.labels import class_ious, confusion, mean_iou
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import complete
from r2flow.reports.pictures import scan_figure
from r2flow.simulator import simulate
from r2flow.stages.transfer import Tasks, Transfer
from tests.conftest import SENSOR, write_run

K = len(COMMON)
ENCODING = {"format": "logscale", "reflectance": True, "labels": True}
EVERY_2ND = (torch.arange(SENSOR.shape[0])[:, None] % 2 == 0).expand(SENSOR.shape)
CONFIG = {
    "sensor": {"name": "hdl64e", "rows": SENSOR.shape[0], "columns": SENSOR.shape[1]},
    "encoding": ENCODING,
    "backbone": {"name": "local", "channels": 8, "dilations": [1, 2]},
    "generator": {"name": "transfer_flow"},
}


def labelled_scans(num: int = 2) -> torch.Tensor:
    """Range, reflectance and common class, (B, 3, H, W)."""
    images = []
    for number in range(num):
        scan = simulate(SENSOR, 0, number)
        images.append(np.concatenate([scan.image, common_classes(scan.labels)[None]]))
    return torch.from_numpy(np.stack(images))


def built(labels: bool = True) -> TransferFlow:
    torch.manual_seed(0)
    flow = build_generator({**CONFIG, "encoding": {**ENCODING, "labels": labels}})
    with torch.no_grad():
        for weight in flow.parameters():
            if not weight.any():
                weight.normal_(std=0.05)
    return flow.eval()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    model = Checkpoint(built(), CONFIG, 0, Path("none"), "r2flow")
    return write_run(tmp_path_factory.mktemp("labels") / "run", model, {"name": "transfer"})


def test_every_class_of_semantic_kitti_has_a_common_class_which_its_id_names():
    classes = np.arange(K + 1)
    np.testing.assert_array_equal(common_classes(semantic_ids(classes)), classes)
    missing = [number for number in CLASSES if common_classes(np.array(number)) == 0]
    assert missing == [0, 1]  # unlabeled and outlier
    assert sum(map(len, COMMON.values())) == len(CLASSES) - 2
    np.testing.assert_array_equal(common_classes(np.array([-1, 2**16, 2])), 0)


def test_labels_are_planes_of_model_space_and_come_back_with_their_probability():
    encoding = Encoding(SENSOR, labels=True)
    assert encoding.shape[0] == 2 + K
    assert [*encoding.slices] == ["range", "reflectance", "label"]
    images = labelled_scans()
    x = encoding.encode(images)
    assert x[:, 2:].max() == 1
    np.testing.assert_array_equal((x[:, 2:] + 1).sum(1) / 2, images[:, 2] > 0)  # one-hot
    decoded = encoding.decode(x)
    torch.testing.assert_close(decoded[:, :3], images, atol=1e-4, rtol=1e-5)
    np.testing.assert_array_equal(decoded[:, 3], images[:, 2] > 0)
    x[:, 2:] = torch.tensor([0.1, 0.7, *[0.2 / 6] * 6])[:, None, None] * 2 - 1
    label, probability = encoding.decode(x)[:, 2:].unbind(1)
    returned = images[:, 0] > 0
    assert (label[returned] == 2).all()
    torch.testing.assert_close(probability, 0.7 * returned)
    with pytest.raises(InputError, match="labels needs encoding.reflectance"):
        Encoding(SENSOR, reflectance=False, labels=True)


def test_each_channel_of_a_ray_is_known_by_itself():
    space = build_space(CONFIG)
    images = labelled_scans()
    state = ray_states(images, EVERY_2ND)
    images[0, 2] = 0  # without labels
    images[1, 1] = 0  # without reflectance
    known = condition_of(space, images, state)["known"]
    np.testing.assert_array_equal(known[:, 0], state != Ray.UNKNOWN)
    assert not known[0, 2:].any()
    np.testing.assert_array_equal(known[1, 2:], (images[1, 2:] > 0).expand(K, -1, -1))
    np.testing.assert_array_equal(known[1, 1], state[1] == Ray.EMPTY)
    np.testing.assert_array_equal(known[0, 1], known[0, 0])


def test_a_labelled_flow_begins_as_its_parent_and_knows_no_class():
    parent = built(labels=False)
    flow = built()
    flow.start_from(parent)
    images = labelled_scans()
    state = ray_states(images, EVERY_2ND)
    images[:, 2] = 0
    each = zip(complete(parent, images[:, :2], state), complete(flow, images, state), strict=True)
    for before, after in each:
        torch.testing.assert_close(after.images[:, :2], before.images, atol=1e-4, rtol=1e-5)
        returned = after.images[:, 0] > 0
        torch.testing.assert_close(after.images[:, 3], returned / K)
    loss = flow.train().loss(**batch(flow, Tasks(rows=8, columns=32, labelling=1.0)))
    assert loss["label"].item() == pytest.approx(math.log(K), abs=1e-5)
    assert loss["range"] == loss["return"] == 0


def batch(flow: TransferFlow, tasks: Tasks) -> dict:
    space = flow.space
    made = tasks(
        space, space.encoding.encode(labelled_scans(1))[0], SENSOR, draws(0, "condition", 0)
    )
    made = {name: value[None] for name, value in made.items()}
    rows = flow.rows(made["elevations"], made["steps"], made["numbered"])
    condition = {"image": made["image"], "known": made["known"]}
    x_1 = made["x_1"]
    return {
        "x_1": x_1, "condition": condition, "t": torch.zeros(1), "noise": torch.zeros_like(x_1),
        "steps": made["steps"], "rows": rows,
    }  # fmt: skip


@pytest.mark.parametrize("sampler", ["jump", "transport"])
def test_known_labels_stay_and_hidden_channels_are_drawn(sampler: str):
    flow = built()
    images = labelled_scans(1)
    state = ray_states(images)
    images[:, 2, :, ::2] = 0
    (answer,) = complete(flow, images, state, sampler=sampler)
    torch.testing.assert_close(answer.images[:, :2], images[:, :2], atol=0, rtol=0)
    known = images[:, 2] > 0
    assert (answer.images[:, 2] == images[:, 2])[known].all()
    assert (answer.images[:, 3] == 1)[known].all()
    returned = images[:, 0] > 0
    assert (answer.images[:, 2] > 0)[returned].all()
    # A map of labels alone becomes a scan.
    maps = labelled_scans(1)
    maps[:, :2] = 0
    (drawn,) = complete(flow, maps, torch.full_like(state, Ray.UNKNOWN), sampler=sampler)
    returned = drawn.images[:, 0] > 0
    known = returned & (maps[:, 2] > 0)
    assert known.any()
    assert (drawn.images[:, 2] == maps[:, 2])[known].all()


@pytest.mark.parametrize(
    ("shares", "known"),
    [({"labelling": 1.0}, (1, 0)), ({"labelling": 0.0, "drawing": 1.0}, (0, 1))],
)
def test_tasks_hide_whole_channels(shares: dict, known: tuple[int, int]):
    flow = built()
    found = batch(flow, Tasks(rows=8, columns=32, **shares))["condition"]["known"][0]
    labels = labelled_scans(1)[0, 2] > 0
    assert (found[:2] == known[0]).all()
    assert found[2:].any() == known[1]
    assert found[2:].sum() <= known[1] * K * labels.sum()


def test_a_labelled_flow_trains_on_labelled_scans_of_each_kind(tmp_path: Path):
    image = labelled_scans(1)[0].numpy()
    xyz, (strength, classes) = image_points(image, SENSOR.rays())
    for number in range(2):
        write_points(tmp_path / f"{number}.bin", xyz, strength)
        write_labels(tmp_path, str(number), classes, np.ones(len(classes)))
    part = {"name": "folder", "root": str(tmp_path)}
    data = ScanDataModule(
        "mixed", sensor=SENSOR, encoding=ENCODING, batch_size=2,
        parts=[part, {"name": "simulated", "scenes": 2}],
    )  # fmt: skip
    model = Transfer(
        backbone=CONFIG["backbone"], sensor=SENSOR, encoding=ENCODING,
        tasks={"rows": 8, "columns": 32},
    )  # fmt: skip
    data.adopt(model.item_format)
    data.setup()
    found = next(iter(data.train_dataloader()))
    loss = model.training_step(found, 0)
    assert torch.isfinite(loss)
    np.testing.assert_array_equal(
        read_image(tmp_path / "0.bin", Reading(SENSOR, labels=True))[2], image[2]
    )
    (tmp_path / "1.label").unlink()
    assert not read_image(tmp_path / "1.bin", Reading(SENSOR, labels=True))[2].any()
    np.save(tmp_path / "0.npy", image[:2])
    (tmp_path / "manifest.json").write_text("{}")  # without it 0.bin might be of another scan
    of_image = read_image(tmp_path / "0.npy", Reading(SENSOR, labels=True))
    np.testing.assert_array_equal(of_image[2], image[2])
    np.save(tmp_path / "2.npy", image[:2])
    assert not read_image(tmp_path / "2.npy", Reading(SENSOR, labels=True))[2].any()
    (tmp_path / "0.label").unlink()
    with pytest.raises(InputError, match="no scan has labels"):
        open_scans(tmp_path, Reading(SENSOR, labels=True))


def test_the_iou_of_a_class_is_that_of_the_sets_of_its_points():
    random = np.random.default_rng(0)
    truth, found = random.integers(0, 5, (2, 300))
    ious = class_ious(confusion(truth, found))
    seen = truth > 0
    for number in range(1, K + 1):
        true = set(np.flatnonzero(seen & (truth == number)))
        said = set(np.flatnonzero(seen & (found == number)))
        expected = len(true & said) / len(true | said) if true | said else math.nan
        assert ious[number - 1] == pytest.approx(expected, nan_ok=True)
    assert mean_iou(confusion(truth, found)) == pytest.approx(np.nanmean(ious))


def test_complete_writes_labels_and_probabilities_and_evaluate_judges_them(
    r2flow, run: Path, tmp_path: Path
):
    image = labelled_scans(1)[0].numpy()
    xyz, (strength, classes) = image_points(image, SENSOR.rays())
    truth = tmp_path / "truth"
    write_points(truth / "0.bin", xyz, strength)
    write_labels(truth, "0", classes, np.ones(len(classes)))
    out = tmp_path / "out"
    done = r2flow("complete", truth / "0.bin", "-c", run, "--out", out, "--hide", "label")
    assert done.returncode == 0, done.stderr
    points = read_points(out / "0.bin")
    ids = np.fromfile(out / "0.label", "<u4")
    with np.load(out / "0.probability.npz") as stored:
        assert len(ids) == len(points.xyz) == len(stored["probability"])
    assert set(ids.tolist()) <= {0, *(group[0] for group in COMMON.values())}
    np.testing.assert_array_equal(points.xyz[: len(xyz)], xyz)
    # Here each pixel is a point.
    counts = Counter(common_classes(ids).astype(int).tolist())
    shares = {
        ["no class", *COMMON][number]: f"{count / len(ids):.0%}"
        for number, count in counts.items()
        if count / len(ids) >= 0.005
    }
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("classes of")]
    printed = line.partition(": ")[2].split(", ")
    assert dict(one.rsplit(" ", 1) for one in printed) == shares
    assert "--hide label" not in done.stdout  # all were found
    assert f"pictures in {out / '0.png'}, in 3-D in {out / '0.html'}" in done.stdout
    page = (out / "0.html").read_text()
    assert '"completed, class, found"' in page
    (classes_shown,) = re.findall(r'"classes":(\[\["no class".*?\]\])', page)
    names = {["no class", *COMMON][number] for number in counts}
    assert {name for name, _ in json.loads(classes_shown)} == names | {"no class"}
    judged = r2flow("evaluate", truth, out, "--metrics", "miou")
    right = np.mean(common_classes(ids[: len(xyz)]) == classes)
    (line,) = [line for line in judged.said.splitlines() if line.startswith("right  ")]
    assert line.split() == ["right", f"{right:.3g}", str(len(xyz))]
    refused = r2flow("evaluate", truth, out, "--metrics", "miou", "--json", tmp_path / "e.json")
    assert "leave --json and --out out" in refused.refusal
    # Labels that are given are kept.
    kept = r2flow("complete", truth / "0.bin", "-c", run, "--out", tmp_path / "kept")
    assert kept.returncode == 0, kept.stderr
    line = "% of these classes are those of 0.label; --hide label finds them anew"
    assert line in kept.stdout
    assert re.search(r'"completed, class, \d+% given"', (tmp_path / "kept/0.html").read_text())
    np.testing.assert_array_equal(
        np.fromfile(tmp_path / "kept/0.label", "<u4")[: len(xyz)], semantic_ids(classes)
    )


def test_a_map_of_labels_becomes_a_scan(r2flow, run: Path, tmp_path: Path):
    labels = semantic_ids(labelled_scans(1)[0, 2].numpy())
    np.save(tmp_path / "map.npy", labels)
    out = tmp_path / "out"
    done = r2flow("complete", tmp_path / "map.npy", "-c", run, "--out", out)
    assert done.returncode == 0, done.stderr
    image = np.load(out / "map.npy")
    assert image.shape == (2, *SENSOR.shape)
    assert (image[0] > 0).any()
    ids = np.fromfile(out / "map.label", "<u4")
    assert len(ids) == len(read_points(out / "map.ply").xyz) == (image[0] > 0).sum()
    assert (
        "give a model with labels"
        in r2flow(
            "complete", tmp_path / "map.npy", "-c", "densify", "--out", tmp_path / "no"
        ).refusal
    )
    np.save(tmp_path / "map.npy", labels[:, :-1])
    again = r2flow("complete", tmp_path / "map.npy", "-c", run, "--out", tmp_path / "no")
    assert "is a map of labels of 8x63, those of the model are 8x64" in again.refusal


def test_a_picture_paints_labels_with_the_names_of_their_classes():
    scan = simulate(SENSOR, 0, 0)
    figure = scan_figure(scan.image, SENSOR.rays(), labels=scan.labels)
    (legend,) = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    names = {text.get_text() for text in legend.get_texts()}
    assert names <= {CLASSES[number][0] for number in np.unique(scan.labels)}
    assert "road" in names
    (painted,) = legend.axes.get_images()
    shown = painted.get_array()[scan.labels == 40]
    np.testing.assert_allclose(shown, np.broadcast_to(to_rgb(CLASSES[40][1]), shown.shape))


def test_labels_alone_of_another_sensor_take_one_evaluation():
    flow = built().at(build_space(CONFIG), numbered=False)
    assert flow.foreign
    images = labelled_scans(1)[:, :2]
    (whole,) = complete(flow, images, ray_states(images))
    (half,) = complete(flow, images, ray_states(images, EVERY_2ND))
    assert (whole.evaluations == 1).all()
    assert (half.evaluations > 1).all()
