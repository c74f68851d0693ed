"""The page of `r2flow view` in headless Chromium, its pixels read back. `pytest -m browser`."""

import math
import shutil
from io import BytesIO

import numpy as np
import pytest
from matplotlib import colormaps

from r2flow.lidar.projection import image_to_points
from r2flow.lidar.sensors import SENSORS
from r2flow.reports.view import Panel, page

pytestmark = pytest.mark.browser

SENSOR = SENSORS["hdl64e"].resized(16, 64)
RAYS = SENSOR.rays()
# (row, column): range
PIXELS = {(4, 30): 22.0, (6, 35): 14.0, (9, 28): 9.0, (3, 40): 31.0, (12, 33): 5.0}
DESKTOP, PHONE = {"width": 1200, "height": 800}, {"width": 390, "height": 844}


def lone(scale: float = 1.0) -> np.ndarray:
    image = np.zeros((2, *SENSOR.shape), np.float32)
    for (row, column), r in PIXELS.items():
        image[:, row, column] = scale * r, 0.5
    return image


def panel(
    *images: np.ndarray,
    caption: str = "scan",
    labels: np.ndarray | None = None,
    frames=(),
    errors=None,
) -> Panel:
    return Panel(caption, np.stack(images), RAYS, labels, frames, errors)


@pytest.fixture(scope="module")
def chromium():
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="needs playwright: pip install r2flow[browser]"
    )
    found = next(
        filter(
            None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))
        ),
        None,
    )
    if found is None:
        pytest.skip("no chromium is installed")
    arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=found, args=arguments)
        yield browser
        browser.close()


@pytest.fixture
def opened(chromium, tmp_path):
    """Opens the page of some panels; no error of its own, no request but for itself."""
    contexts, errors, requests = [], [], []

    def open(*panels, size=DESKTOP, title="r2flow"):
        path = tmp_path / "page.html"
        path.write_text(page(panels, title), encoding="utf-8")
        contexts.append(chromium.new_context(viewport=size, color_scheme="dark"))
        shown = contexts[-1].new_page()
        shown.on("pageerror", lambda error: errors.append(str(error)))
        shown.on(
            "console",
            lambda message: errors.append(message.text) if message.type == "error" else None,
        )
        shown.on("request", lambda request: requests.append(request.url))
        shown.on("dialog", lambda dialog: errors.append(f"dialog {dialog.message}"))
        shown.goto(path.as_uri(), timeout=120_000)
        shown.wait_for_selector("html[data-ready]", state="attached", timeout=120_000)
        settle(shown)
        return shown

    yield open
    for context in contexts:
        context.close()
    assert errors == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in requests)


def settle(shown) -> None:
    """Until what was asked for is drawn: two frames after the last movement has rested."""
    shown.wait_for_timeout(400)
    shown.evaluate(
        "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )


def screen(shown) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(BytesIO(shown.screenshot())).convert("RGB")).astype(int)


def colour_by(shown, mode: str) -> None:
    shown.locator("#modes button", has_text=mode).click()
    settle(shown)


def camera_of(shown) -> dict:
    return shown.evaluate("() => ({...window.view.camera})")


def projected(point: np.ndarray, camera: dict, box: dict) -> np.ndarray:
    """Where a pinhole camera sees a point on the screen: 50 degrees upwards, more where the view is
    narrow.
    """
    yaw, pitch = camera["yaw"], camera["pitch"]
    ahead = -np.array(
        [math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)]
    )
    eye = np.array(camera["target"]) - camera["distance"] * ahead
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    tangent = math.tan(math.radians(25)) * max(1, 1.2 * box["height"] / box["width"])
    focal = box["height"] / 2 / tangent
    seen = np.asarray(point) - eye
    x, y = focal * (seen @ right) / (seen @ ahead), focal * (seen @ up) / (seen @ ahead)
    return np.array([box["x"] + box["width"] / 2 + x, box["y"] + box["height"] / 2 - y])


def points_of(image: np.ndarray) -> dict[tuple[int, int], np.ndarray]:
    """The point of each of `PIXELS`, each alone through the project's own unprojection."""
    alone = {place: np.zeros_like(image) for place in PIXELS}
    for place, one in alone.items():
        one[:, *place] = image[:, *place]
    return {place: image_to_points(one, RAYS)[0][0] for place, one in alone.items()}


def colour_of_range(r: float, ranges: list[float]) -> np.ndarray:
    """As the pictures of the project have it: turbo from 0.93 down to 0.1 by the logarithm, from
    0.9 of the 2 % quantile of a page's ranges to 1.1 of that at 98 %.
    """
    near, far = np.quantile(ranges, (0.02, 0.98)) * (0.9, 1.1)
    share = int(np.clip(math.log(r / near) / math.log(far / near) * 256, 0, 255)) / 255
    return 255 * np.array(colormaps["turbo"](0.9 - 0.83 * share)[:3])


@pytest.mark.parametrize(
    "keys", [[], ["ArrowLeft"] * 4 + ["ArrowUp"] * 2, ["t"]], ids=["first", "turned", "above"]
)
def test_points_are_drawn_where_the_camera_sees_them_in_the_colour_of_their_range(opened, keys):
    shown = opened(panel(lone()))
    colour_by(shown, "range")
    for key in keys:
        shown.keyboard.press(key)
    settle(shown)
    pixels, camera, box = screen(shown), camera_of(shown), shown.locator(".points").bounding_box()
    drawn = 0
    for place, point in points_of(lone()).items():
        x, y = projected(point, camera, box)
        if not (
            box["x"] + 40 < x < box["x"] + box["width"] - 40
            and box["y"] + 40 < y < box["y"] + box["height"] - 40
        ):
            continue
        drawn += 1
        at = pixels[round(y - 0.5), round(x - 0.5)]
        expected = colour_of_range(PIXELS[place], [*PIXELS.values()])
        assert np.abs(at - expected).max() <= 4, (place, at)
        # 30 pixels above and below: the background
        around = pixels[round(y) - 30 : round(y) + 30 : 59, round(x)]
        assert (around.max(axis=1) < 45).all()
    assert drawn >= 3


def test_the_image_below_is_the_range_image(opened):
    image = np.random.default_rng(0).uniform(2, 80, (1, *SENSOR.shape)).astype(np.float32)
    image[0, :, ::3] = 0
    shown = opened(panel(image))
    colour_by(shown, "range")
    box, pixels = shown.locator(".image").bounding_box(), screen(shown)
    for (row, column), r in np.ndenumerate(image[0]):
        x = box["x"] + (column + 0.5) / 64 * box["width"]
        y = box["y"] + 1 + (row + 0.5) / 16 * (box["height"] - 1)
        expected = colour_of_range(r, image[image > 0].tolist()) if r else np.zeros(3)
        assert np.abs(pixels[int(y), int(x)] - expected).max() <= 4, (row, column)


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_mouse_and_keys_move_the_camera(opened, size):
    shown = opened(panel(lone()), size=size)
    first, box = camera_of(shown), shown.locator(".points").bounding_box()
    x, y = box["x"] + 300, box["y"] + 200
    shown.mouse.move(x, y)
    shown.mouse.down()
    shown.mouse.move(x + 50, y + 20)
    shown.mouse.up()
    turned = camera_of(shown)
    assert turned["yaw"] == pytest.approx(first["yaw"] - 0.4)
    assert turned["pitch"] == pytest.approx(first["pitch"] + 0.16)
    shown.mouse.move(x, y)
    shown.mouse.down(button="right")
    shown.mouse.move(x + 50, y)
    shown.mouse.up(button="right")
    moved = camera_of(shown)
    # What was in the middle has followed the mouse.
    middle = projected(turned["target"], moved, box) - [
        box["x"] + box["width"] / 2,
        box["y"] + box["height"] / 2,
    ]
    assert middle == pytest.approx([50, 0], abs=0.5)
    assert (
        shown.locator("#tiles").evaluate("tiles => getComputedStyle(tiles).outlineStyle") == "none"
    )
    assert math.dist(moved["target"], turned["target"]) > 0.5
    shown.mouse.wheel(0, -100)
    shown.wait_for_function(
        "distance => window.view.camera.distance < distance", arg=moved["distance"]
    )
    shown.keyboard.press("r")
    assert camera_of(shown) == first
    shown.locator("#reset").click()
    shown.keyboard.press("ArrowRight")  # of the page, not of the button that has the focus
    assert camera_of(shown)["yaw"] == pytest.approx(first["yaw"] + 0.09)
    for opens in (True, False):
        shown.keyboard.press("?")
        shown.locator(f"#help[aria-expanded={str(opens).lower()}]").wait_for()
        assert shown.locator("#keys").is_visible() == opens


def test_the_cursor_finds_the_point_and_back(opened):
    shown = opened(panel(lone(), caption="a"), panel(lone(0.8), caption="b"))
    first, second = shown.locator(".points").all()
    strip = shown.locator(".image").first.bounding_box()
    for (row, column), r in PIXELS.items():
        shown.mouse.move(
            strip["x"] + (column + 0.5) / 64 * strip["width"],
            strip["y"] + (row + 0.5) / 16 * strip["height"],
        )
        assert (
            shown.locator("#readout")
            .inner_text()
            .startswith(f"row {row}, column {column} · {r:.2f} m")
        )
        for tile, image in ((first, lone()), (second, lone(0.8))):
            box, mark = tile.bounding_box(), tile.locator(".mark").bounding_box()
            at = projected(points_of(image)[row, column], camera_of(shown), box)
            assert [mark["x"] + 9, mark["y"] + 9] == pytest.approx(at, abs=1.0)
        shown.mouse.move(
            *projected(points_of(lone())[row, column], camera_of(shown), first.bounding_box())
        )
        assert shown.locator("#readout").inner_text().startswith(f"row {row}, column {column} ·")
    shown.mouse.move(strip["x"] + 3, strip["y"] + strip["height"] / 2)
    assert "no return" in shown.locator("#readout").inner_text()


def test_the_slider_goes_through_the_frames(opened):
    shown = opened(panel(lone(), lone(0.5), frames=["t = 0", "t = 1"]), panel(lone()))
    strips = [one.bounding_box() for one in shown.locator(".image").all()]
    assert shown.locator("#frame-name").inner_text() == "t = 0"
    shown.keyboard.press(".")
    shown.wait_for_function("() => document.getElementById('frame-name').textContent === 't = 1'")
    for strip, r in zip(strips, (7.0, 14.0), strict=True):
        shown.mouse.move(
            strip["x"] + 35.5 / 64 * strip["width"], strip["y"] + 6.5 / 16 * strip["height"]
        )
        assert f"column 35 · {r:.2f} m" in shown.locator("#readout").inner_text()


def test_only_what_is_there_can_be_coloured(opened):
    shown = opened(panel(lone()[:1]))
    assert shown.locator("#modes button").all_inner_texts() == ["range", "height"]
    assert shown.locator("#player").is_hidden()
    colour_by(shown, "range")
    # 0.9 of 5.32 m (2 %), 1.1 of 30.28 m (98 %), and the root of their product between
    assert shown.locator("#legend span").all_inner_texts() == ["range 4.8 m", "13 m", "33 m"]
    shown = opened(panel(lone(), labels=np.full((1, *SENSOR.shape), 40)))
    settle(shown)  # labels are shown first
    assert shown.locator("#legend span").all_inner_texts() == ["road", "no class"]
    box, point = shown.locator(".points").bounding_box(), points_of(lone())[6, 35]
    x, y = projected(point, camera_of(shown), box)
    assert np.abs(screen(shown)[round(y - 0.5), round(x - 0.5)] - [0x9A, 0x86, 0xC9]).max() <= 4


# Of `PIXELS` by their predicted error, the first measured; the colours are those of the pictures.
ERRORS = dict(zip(PIXELS, (0, 0.04, 0.15, 0.7, 3), strict=True))
HUES = ("#74c0fc", "#2f9e44", "#fcc419", "#f76707", "#c92a2a")


def completed() -> list[Panel]:
    """The measured point alone, and with the others, all other rays measured but one."""
    errors = np.zeros((1, *SENSOR.shape))
    errors[0, *zip(*PIXELS, strict=True)] = [*ERRORS.values()]
    own = lone() * (errors == 0)
    unknown = np.where(errors > 0, np.nan, 0)
    return [panel(own, caption="own", errors=unknown), panel(lone(), caption="all", errors=errors)]


def seen(shown, tile: int = -1) -> list[bool]:
    """Which of `PIXELS` are drawn in a panel in the colour of their error."""
    pixels, box = screen(shown), shown.locator(".points").nth(tile).bounding_box()
    places = [projected(at, camera_of(shown), box) for at in points_of(lone()).values()]
    found = [pixels[round(y - 0.5), round(x - 0.5)] for x, y in places]
    hues = [[int(hue[i : i + 2], 16) for i in (1, 3, 5)] for hue in HUES]
    return [np.abs(at - hue).max() <= 4 for at, hue in zip(found, hues, strict=True)]


def test_points_are_hidden_by_kind_and_by_their_predicted_error(opened):
    shown = opened(*completed())
    assert shown.locator("#modes [aria-pressed=true]").inner_text() == "height"
    for key in ("t", "g"):  # from above without rings
        shown.keyboard.press(key)
    colour_by(shown, "predicted error")
    assert seen(shown) == [True] * 5
    assert seen(shown, 0) == [True] + [False] * 4
    slider = shown.locator("#error")
    slider.fill("5")  # the sixth step, 0.2 m
    settle(shown)
    assert seen(shown) == [True, True, True, False, False]
    said = "0.2 m: 50 % of 4 added points are shown"
    assert slider.get_attribute("aria-valuetext") == said
    shown.locator("figcaption button").first.click()  # alone and back
    shown.keyboard.press("Escape")
    settle(shown)
    shown.keyboard.press("e")  # 0.15 m
    shown.keyboard.press("m")
    settle(shown)
    assert seen(shown) == [False, True, True, False, False]
    assert seen(shown, 0) == [False] * 5
    assert shown.locator("#measured").get_attribute("aria-pressed") == "false"
    for _ in range(6):
        shown.keyboard.press("Shift+E")
    shown.locator("#measured").click()
    settle(shown)
    assert seen(shown) == [True] * 5
    assert shown.locator("#kept").inner_text() == "any: 100 %"
    shown.keyboard.press("a")
    settle(shown)
    assert seen(shown) == [True] + [False] * 4
    strip = shown.locator(".image").last.bounding_box()
    shown.mouse.move(
        strip["x"] + 35.5 / 64 * strip["width"], strip["y"] + 6.5 / 16 * strip["height"]
    )
    assert shown.locator("#readout").inner_text().endswith("added, error up to 0.05 m")


def test_rays_without_return_and_those_not_measured_differ(opened):
    shown = opened(*completed())
    assert shown.locator("#legend span").all_inner_texts()[-2:] == ["not measured", "no return"]
    strip, pixels = shown.locator(".image").first.bounding_box(), screen(shown)
    colours = {}
    for row, column in ((6, 35), (7, 35)):
        x = strip["x"] + (column + 0.5) / 64 * strip["width"]
        y = strip["y"] + 1 + (row + 0.5) / 16 * (strip["height"] - 1)
        colours[row] = pixels[int(y), int(x)].tolist()
        shown.mouse.move(x, y)
        said = shown.locator("#readout").inner_text()
        assert said.endswith("not measured" if row == 6 else "no return")
    assert colours == {6: [0x4A, 0x55, 0x63], 7: [0, 0, 0]}


def test_rings_lie_at_their_metres_on_the_ground(opened):
    shown = opened(panel(lone()))
    shown.keyboard.press("t")
    settle(shown)
    ground = np.percentile([point[2] for point in points_of(lone()).values()], 2)
    box, camera, with_rings = (
        shown.locator(".points").bounding_box(),
        camera_of(shown),
        screen(shown),
    )
    shown.locator("#rings[aria-pressed=true]").click()
    settle(shown)
    differ = (with_rings != screen(shown)).any(-1)
    # 98 % of the points lie within 30.3 m: up to five rings in steps of 10 m
    for radius in (10, 20, 30):
        angles = np.linspace(0, 2 * np.pi, 50)
        at = [
            projected(np.array([radius * np.cos(a), radius * np.sin(a), ground]), camera, box)
            for a in angles
        ]
        inside = [
            (round(y), round(x)) for x, y in at if box["y"] + 5 < y < box["y"] + box["height"] - 5
        ]
        assert len(inside) > 15
        hits = [differ[y - 2 : y + 3, x - 2 : x + 3].any() for y, x in inside]
        assert np.mean(hits) == 1
    assert shown.locator(".ring").all_inner_texts() == ["10 m", "20 m", "30 m"]
    assert shown.locator(".ring:visible").count() == 0


def test_labels_come_first_where_most_scans_have_some(opened):
    labels = np.full((1, *SENSOR.shape), 40)
    shown = opened(panel(lone()), panel(lone(), labels=labels), panel(lone()))
    assert shown.locator("#modes [aria-pressed=true]").inner_text() == "height"
    colour_by(shown, "label")
    assert shown.locator("figcaption small").all_inner_texts() == ["no label", "", "no label"]
    shown = opened(panel(lone()), panel(lone(), labels=labels))
    assert shown.locator("#modes [aria-pressed=true]").inner_text() == "label"


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_title_and_controls_of_a_completed_scan_are_not_cut(opened, size):
    title = "000000, at hidden rays: mean error 0.983 m, best interpolation (linear, 1/r) 1.249 m"
    shown = opened(*completed(), size=size, title=title)
    sizes = shown.evaluate(
        "() => { const h = document.querySelector('h1'); "
        "return [h.scrollWidth - h.clientWidth, h.scrollHeight - h.clientHeight]; }"
    )
    assert max(sizes) <= 0
    for one in shown.locator("button:visible, input:visible, output:visible").all():
        box = one.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= size["width"]


@pytest.mark.parametrize(("size", "count"), [(DESKTOP, 16), (PHONE, 6)])
def test_everything_fits_and_the_rest_is_turned_to(opened, size, count):
    shown = opened(*(panel(lone(), caption=str(number)) for number in range(20)), size=size)
    for box in [one.bounding_box() for one in shown.locator("figure, button:visible").all()]:
        for start, length in (("x", "width"), ("y", "height")):
            assert box[start] >= 0
            assert box[start] + box[length] <= size[length]
    seen = shown.locator("figure").count()
    assert count <= seen <= 16
    shown.locator("#next").click()
    assert shown.locator("figcaption span").first.inner_text() == str(seen)
    shown.locator("figcaption button").first.click()
    assert shown.locator("figure").count() == 1
    shown.keyboard.press("Escape")
    assert shown.locator("figure").count() > 1
