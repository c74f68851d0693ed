"""The page of `r2flow view` without a browser: what it holds, and what it refuses."""

import base64
import hashlib
import json
import zlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow import load
from r2flow.base.errors import InputError
from r2flow.lidar.labels import CLASSES
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_cloud, write_points
from r2flow.lidar.scan_files.cloud import Cloud
from r2flow.lidar.sensors import SENSORS
from r2flow.reports.view import MOST, Panel, page
from r2flow.simulator import simulate
from r2flow.simulator.folder import SimulatedFolder
from tests.conftest import ground
from tests.simulator.test_folder import write_folder

SENSOR = SENSORS["hdl64e"].resized(8, 32)
RAYS = SENSOR.rays()
ATTACK = "</script><img src=x onerror=alert(1)><!-- <script>&\"' $title ${data}"


class Parsed(HTMLParser):
    """Elements of a page, and the text within scripts and styles, as a browser cuts it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict]] = []
        self.texts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        self.texts.append("")

    def handle_endtag(self, tag):
        self.handle_starttag(f"/{tag}", [])

    def handle_data(self, data):
        if self.texts:
            self.texts[-1] += data

    def all(self, tag: str) -> list[tuple[dict, str]]:
        found = zip(self.elements, self.texts, strict=True)
        return [(attributes, text) for (name, attributes), text in found if name == tag]

    @property
    def data(self) -> dict:
        (text,) = (
            text for attributes, text in self.all("script") if attributes.get("id") == "data"
        )
        return json.loads(text)


def images(count: int, channels: int = 2, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    r = rng.uniform(1.45, 80, (count, 1, *SENSOR.shape)) * (
        rng.random((count, 1, *SENSOR.shape)) < 0.8
    )
    return np.concatenate([r, rng.random(r.shape) * (r > 0)], 1)[:, :channels].astype(np.float32)


def page_of(*images: np.ndarray, rays: torch.Tensor = RAYS) -> str:
    return page([Panel("scan", image[None], rays) for image in images])


def unpacked(data: dict, number: int, frame: int = 0) -> list[np.ndarray]:
    """Range in metres, reflectance and class number of one image, by the format's description
    alone.
    """
    one = data["scans"][number]
    rays = data["rays"][one["rays"]]
    shape = rays["rows"], rays["columns"]
    raw = np.frombuffer(zlib.decompress(base64.b64decode(one["frames"][frame])), np.uint8)
    high, low, *others = raw.reshape(-1, *shape).astype(np.int64)
    return [np.cumsum(256 * high + low, axis=1) % 65536 * data["metres"], *others]


@pytest.mark.parametrize("farthest", [80.0, 900.0], ids=["80 m", "900 m"])
def test_what_is_unpacked_is_the_scan(farthest):
    given = images(2)
    given[1, 0, 3, 5] = farthest
    given[0, 0, 0, :2], given[1, 0, 0, 0] = (np.nan, -1), np.inf
    data = Parsed(page_of(*given)).data
    # other values are not returns
    for number, image in enumerate(np.nan_to_num(given.clip(0), posinf=0)):
        r, reflectance = unpacked(data, number)
        assert np.abs(r - image[0]).max() <= max(0.002, farthest / 65535 / 2) + 1e-5
        assert ((r == 0) == (image[0] == 0)).all()
        assert np.abs(reflectance / 255 - image[1]).max() <= 0.5 / 255 + 1e-6
    (rays,) = data["rays"]
    e, a = np.meshgrid(rays["elevations"], rays["azimuths"], indexing="ij")
    np.testing.assert_allclose(np.stack([e, a]), RAYS.numpy(), atol=2e-7)


def test_labels_have_their_names_and_colours():
    ids = np.full(SENSOR.shape, 40)
    ids[:2], ids[7] = 11, 0  # a bicycle is no class of a labelled model
    panels = [
        Panel("scan", image[None], RAYS, of)
        for image, of in zip(images(2, 1), (ids[None], None), strict=True)
    ]
    data = Parsed(page(panels)).data
    assert [one["labels"] for one in data["scans"]] == [True, False]
    assert [one["reflectance"] for one in data["scans"]] == [False, False]
    _, numbers = unpacked(data, 0)
    assert data["classes"][numbers[0, 0]] == list(CLASSES[11])
    assert data["classes"][numbers[4, 0]] == list(CLASSES[40])
    assert data["classes"][numbers[7, 0]][0] == "no class"


ERRORS = np.full(SENSOR.shape, 0.3)
ERRORS[0, :6] = 0, 0.01, 0.2, 0.21, 7, np.nan


def test_errors_are_stored_as_the_step_of_the_slider_that_they_need():
    data = Parsed(page([Panel("scan", images(1), RAYS, errors=ERRORS[None])])).data
    steps = data["trust"]["steps"]
    *_, numbers = unpacked(data, 0)
    assert numbers[0, 0] == 0
    assert [steps[number - 1] for number in numbers[0, 1:4]] == [0.02, 0.2, 0.3]
    assert (numbers[0, 4:6] - len(steps)).tolist() == [1, 2]
    assert steps[numbers[1, 0] - 1] == 0.3


def test_a_usual_scan_takes_about_130_kb():
    made = simulate(SENSORS["hdl64e"], 0, 0)
    empty, one = (
        len(page_of(image, rays=SENSORS["hdl64e"].rays())) for image in (0 * made.image, made.image)
    )
    assert one - empty < 140_000
    assert empty < 70_000


def test_no_text_is_read_as_html():
    parsed = Parsed(
        page([Panel(ATTACK, images(1), RAYS, np.full((1, *SENSOR.shape), 600), [ATTACK])], ATTACK)
    )
    assert [attributes.get("type") for attributes, _ in parsed.all("script")] == [
        "application/json",
        "module",
    ]
    assert not parsed.all("img")
    assert parsed.data["scans"][0]["caption"] == parsed.data["frames"][0] == ATTACK
    assert (
        [said for _, said in parsed.all("title")]
        == [said.strip() for _, said in parsed.all("h1")]
        == [ATTACK]
    )


def test_the_page_allows_its_own_script_alone_and_loads_nothing():
    text = page_of(*images(1))
    parsed = Parsed(text)
    (policy,) = (a["content"] for a, _ in parsed.all("meta") if "http-equiv" in a)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    script = next(
        said for attributes, said in parsed.all("script") if attributes["type"] == "module"
    )
    (style,) = (said for _, said in parsed.all("style"))
    for rule, said in (("script-src", script), ("style-src", style)):
        assert (
            rules[rule]
            == f"'sha256-{base64.b64encode(hashlib.sha256(said.encode()).digest()).decode()}'"
        )
    assert rules["default-src"] == "'none'"
    assert "http://" not in text.replace("http-equiv", "")
    assert "https://" not in text


def test_what_does_not_fit_is_refused():
    for panels in (
        [],
        [Panel("scan", np.broadcast_to(np.float32(0), (MOST // 256 + 1, 1, 8, 32)), RAYS)],
    ):
        with pytest.raises(InputError, match="found (0|65537) images"):
            page(panels)


class TestTheVerb:
    @pytest.fixture
    def scan(self, tmp_path: Path) -> Path:
        sensor = SENSORS["hdl64e"]
        write_points(tmp_path / "ground.bin", *image_to_points(ground(sensor), sensor.rays()))
        return tmp_path / "ground.bin"

    def test_shows_files_and_says_how_many_of_a_folder(self, r2flow, scan, tmp_path):
        many = tmp_path / "many"
        many.mkdir()
        for number, image in enumerate(images(5)):
            np.save(many / f"{number}{ATTACK.replace('/', '')}.npy", image)
        said = r2flow("view", scan, many, "--num", 3, "--out", tmp_path / "a.html").said
        assert said == f"{many}: 3 of its 5 scans, evenly spread (--num)\n{tmp_path / 'a.html'}\n"
        data = Parsed((tmp_path / "a.html").read_text()).data
        assert [one["caption"][:1] for one in data["scans"]] == ["g", "0", "2", "4"]
        r, _ = unpacked(data, 0)
        e = SENSORS["hdl64e"].rays()[0].numpy()
        np.testing.assert_allclose(r[40:60], (-1.73 / np.sin(e))[40:60], atol=0.003)

    @pytest.mark.parametrize("given", [["."], ["a", "b"], ["a/data/0.ply", "b/data/0.ply"]])
    def test_what_is_shown_together_has_one_scale_of_reflectance_and_differs_in_caption(
        self, r2flow, tmp_path, given
    ):
        for name, highest in (("a", 80), ("b", 204)):
            write_points(
                tmp_path / "in" / name / "data" / "0.ply",
                np.array([[10.0, 0, 0]]),
                np.array([highest]),
            )
        scans = [tmp_path / "in" / name for name in given]
        assert r2flow("show", *scans, "--format", "npy", "-o", tmp_path)[0] == 0
        assert [np.load(tmp_path / f"{n}.npy")[1].max() for n in ("0", "0_2")] == pytest.approx(
            [80 / 255, 0.8]
        )
        assert r2flow("view", *scans, "-o", tmp_path / "a.html")[0] == 0
        data = Parsed((tmp_path / "a.html").read_text()).data
        assert [one["caption"] for one in data["scans"]] == ["a/data/0.ply", "b/data/0.ply"]

    @pytest.mark.parametrize("ending", ["pcd", "bin"])
    def test_reads_the_predicted_errors_of_a_completed_scan(self, r2flow, tmp_path, ending):
        image = np.stack([np.full(SENSOR.shape, 10), np.nan_to_num(ERRORS)]).astype(np.float32)
        xyz, errors = image_to_points(image, RAYS)
        x, errors = np.insert(xyz, 0, np.nan, axis=0).T, np.insert(errors, 0, 9)  # a lost ray first
        cloud = Cloud(("x", "y", "z", "i"), (*x, 0 * errors), held=4)
        fields = {"measured": (errors == 0).astype("u1"), "error_68": errors}
        write_cloud(tmp_path / f"a.{ending}", cloud.with_fields(fields))
        assert r2flow("view", tmp_path, "--size", "8x32", "-o", tmp_path / "a.html")[0] == 0
        data = Parsed((tmp_path / "a.html").read_text()).data
        *_, numbers = unpacked(data, 0)
        limits = np.array([0, *data["trust"]["steps"]])
        assert np.array_equal(numbers, (image[1][..., None] > limits).sum(-1))

    def test_a_sequence_is_one_scan_with_frames(self, r2flow, tmp_path, monkeypatch):
        monkeypatch.setenv("HOME", str(tmp_path))
        for name, image in zip("ab", images(2), strict=True):
            np.save(tmp_path / f"{name}.npy", image)
        assert r2flow("view", "folder:~", "--sequence", "--out", tmp_path / "a.html")[0] == 0
        data = Parsed((tmp_path / "a.html").read_text()).data
        assert [len(one["frames"]) for one in data["scans"]] == [2]
        assert data["frames"] == ["a.npy", "b.npy"]

    def test_draws_a_model_at_several_steps_from_the_same_noise(self, r2flow, saved, tmp_path):
        assert (
            r2flow("view", saved[0], "--num", 2, "--steps", "1,3", "--out", tmp_path / "a.html")[0]
            == 0
        )
        data = Parsed((tmp_path / "a.html").read_text()).data
        names = [f"{saved[0]}, seed 0, {steps}" for steps in ("1 step", "3 steps")]
        assert [one["caption"] for one in data["scans"]] == names
        expected = load(saved[0]).sample(2, steps=3)
        for frame in range(2):
            assert np.abs(unpacked(data, 1, frame)[0] - expected[frame, 0].numpy()).max() < 0.0021

    def test_sees_scans_through_the_sensor_of_a_model(self, r2flow, saved, scan, tmp_path):
        own = SimulatedFolder(tmp_path / "own", SENSORS["vlp16"].resized(16, 64), 0, ("bin",))
        write_folder(own, [0], workers=1)
        wide = scan, saved[0], "--size", "64x1024"
        for what, rows in (((saved[0], scan, own.folder), [8, 8, 16]), (wide, [64, 8])):
            assert r2flow("view", *what, "--num", 1, "--out", tmp_path / "a.html").quiet
            data = Parsed((tmp_path / "a.html").read_text()).data
            assert [data["rays"][one["rays"]]["rows"] for one in data["scans"]] == rows

    @pytest.mark.parametrize("screen", [True, False])
    def test_opens_a_browser_where_there_is_a_screen(self, r2flow, tmp_path, monkeypatch, screen):
        opened = []
        np.save(tmp_path / "a.npy", images(1)[0])
        monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url))
        monkeypatch.setattr("sys.platform", "linux")
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        monkeypatch.setenv("DISPLAY", ":0") if screen else monkeypatch.delenv(
            "DISPLAY", raising=False
        )
        said = r2flow("view", tmp_path / "a.npy").said
        assert opened == ([f"file://{said.strip()}"] if screen else [])
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        monkeypatch.setattr("r2flow.reports.view.MOST", 1)
        assert "Take fewer scans" in r2flow("view", tmp_path / "a.npy").refusal
        assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]
