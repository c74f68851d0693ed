"""Scans in 3-D as a self-contained HTML page: `r2flow view`.

    rays = flow.sensor.rays()
    panels = [Panel(f"sample {i}", image[None], rays) for i, image in
    enumerate(flow.sample(4).numpy())] write_viewer(Path("scans.html"), panels)

The page stores two bytes of range and one of reflectance per pixel, compressed by zlib, and the
rays once; the browser computes the points.
"""

import base64
import hashlib
import html
import json
import zlib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray
from torch import Tensor

from r2flow.base.errors import InputError, printable
from r2flow.base.files import write_file
from r2flow.lidar.labels import semantic_ids
from r2flow.reports.pictures import (
    TRUST,
    TRUST_LIMITS,
    TRUST_TITLE,
    class_colours,
    colours,
    view_of,
)

MOST = 256 * 64 * 1024  # maximum pixels of all images of a page: about 33 MB
STEP = 0.004  # metres per range code: uint16 reaches 262 m with errors of at most 2 mm
_CODES = 2**16
_SCALES = ("range", "height", "reflectance")  # in the order of `view.js`
_STEPS = (0.02, 0.03, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0)  # of the page's slider, metres
#: How a page names and colours points by their predicted error.
TRUST_SCALE = {
    "title": TRUST_TITLE,
    "steps": _STEPS,
    "limits": TRUST_LIMITS,
    "classes": [*TRUST.values()],
}


class Panel(NamedTuple):
    """One scan of a page, or a sequence of scans for the slider."""

    caption: str
    images: ndarray  # range in metres and reflectance, (T, 2 or 1, H, W); 0 for dropped rays
    rays: Tensor  # elevation and azimuth in radians, (2, H, W)
    labels: ndarray | None = None  # semantic ids, (T, H, W)
    frames: Sequence[str] = ()  # slider captions
    # `error_68` of added points, metres; 0 of measured rays, NaN of others without one, (T, H, W)
    errors: ndarray | None = None


def panel_of(caption: str, images: ndarray, rays: Tensor, frames: Sequence[str] = ()) -> Panel:
    """The panel of a model's images, (T, C, H, W): their third channel are labels, if there is
    one.
    """
    labels = semantic_ids(images[:, 2]) if images.shape[1] > 2 else None
    return Panel(caption, images[:, :2], rays, labels, frames)


def page(panels: Sequence[Panel], title: str = "r2flow") -> str:
    """One HTML page with a point cloud and a range image per panel, under a shared camera.

    Panels may differ in size and number of frames. The page takes about 50 kB and 130 kB for each
    image of 64 x 1024. Texts in it are never read as HTML.
    """
    # Only "<" could end the script element.
    data = json.dumps(_contents(panels), separators=(",", ":"), allow_nan=False)
    return document(title, data.replace("<", "\\u003c"))


def document(title: str, data: str) -> str:
    """The page around its data, a JSON text."""
    style, script = assets()
    # The content security policy allows only this script and this style, by hash.
    return Template(_asset("view.html")).substitute(
        title=html.escape(printable(title)),
        data=data,
        style=style,
        script=script,
        style_hash=digest(style),
        script_hash=digest(script),
    )


def assets() -> tuple[str, str]:
    """Style and script of the page."""
    return _asset("view.css"), _asset("view.js")


def _asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")


def _contents(panels: Sequence[Panel]) -> dict[str, Any]:
    """What the script of a page draws."""
    count = sum(len(panel.images) for panel in panels)
    pixels = sum(panel.images[:, 0].size for panel in panels)
    if not 0 < pixels <= MOST:
        raise InputError(
            f"a page holds 1 to 256 images of 64 x 1024 (33 MB), or {MOST:,} pixels; found {count} "
            "images with "
            f"{pixels:,}. Take fewer scans or frames (--num)."
        )
    described = []
    labelled = [panel.labels[panel.labels > 0] for panel in panels if panel.labels is not None]
    classes = class_colours(np.concatenate(labelled), most=255) if labelled else {}
    farthest = max(np.nan_to_num(panel.images[:, 0], posinf=0).max() for panel in panels)
    step = max(STEP, float(farthest) / (_CODES - 1))
    scans = []
    for panel in panels:
        rays = described_rays(np.asarray(panel.rays, dtype=np.float64))
        if rays not in described:
            described.append(rays)
        planes = []
        if panel.labels is not None:
            planes.append(_class_numbers(panel.labels, classes))
        if panel.errors is not None:
            # 0 of measured rays, then the step that an error needs, then one more, and NaN last
            numbers = np.searchsorted((0, *_STEPS, np.inf), panel.errors)
            planes.append(numbers.astype(np.uint8))
        scans.append(
            {
                "caption": printable(panel.caption),
                "rays": described.index(rays),
                "frames": [
                    _packed_image(image, step, *numbers)
                    for image, *numbers in zip(panel.images, *planes, strict=True)
                ],
                "reflectance": panel.images.shape[1] > 1,
                "labels": panel.labels is not None,
                "errors": panel.errors is not None,
            }
        )
    view = view_of(*((panel.images[0], panel.rays) for panel in panels))
    return {
        "scans": scans,
        "rays": described,
        "frames": [printable(frame) for frame in max((p.frames for p in panels), key=len)],
        "metres": step,
        "ranges": view.ranges,
        "heights": view.heights,
        "colours": colour_table(),
        "classes": [("no class", "#808080"), *classes.values()],
        "trust": TRUST_SCALE,
    }


def colour_table() -> str:
    """256 colours of each scale, in base64."""
    table = [colours(name)(np.arange(256), bytes=True) for name in _SCALES]
    return _base64(np.stack(table).tobytes())


def write_viewer(path: Path, panels: Sequence[Panel], title: str = "r2flow") -> Path:
    """Write `page` to a file."""
    write_file(path, page(panels, title))
    return path


def most_images(shape: Sequence[int]) -> int:
    """Maximum number of images (..., H, W) on a page."""
    return MOST // int(np.prod(shape[-2:]))


def _packed_image(image: ndarray, step: float, *numbers: ndarray) -> str:
    """Encode an image, (2 or 1, H, W), as byte planes of H W each, compressed by zlib, in base64.

    Planes: high and low bytes of range codes, as differences along each row modulo 2^16; optionally
    reflectance in 255 levels; `numbers` of classes and errors. Code c means c `step` metres, 0 no
    return.
    """
    r = np.nan_to_num(image[0].astype(np.float64), posinf=0, neginf=0)
    codes = np.where(r > 0, np.clip(np.rint(r / step), 1, _CODES - 1), 0).astype(np.int32)
    differences = (np.diff(codes, axis=1, prepend=0) % _CODES).astype(">u2")
    planes = [differences.view(np.uint8).reshape(-1, 2).T.tobytes()]
    if len(image) > 1:
        planes.append(np.rint(255 * np.nan_to_num(image[1]).clip(0, 1)).astype(np.uint8).tobytes())
    planes += [plane.tobytes() for plane in numbers]
    return _base64(zlib.compress(b"".join(planes), 6))


def described_rays(rays: ndarray) -> dict[str, Any]:
    """Rays, (2, H, W), as elevations of rows and azimuths of columns, which all sensors have."""
    elevations = rays[0, :, 0]
    azimuths = rays[1, 0]
    # The geometric mean of the median angles between neighbouring rows and columns, in radians.
    gaps = [np.median(np.abs(np.diff(x))) for x in (elevations, azimuths) if len(x) > 1]
    return {
        "rows": len(elevations),
        "columns": len(azimuths),
        "spacing": float(np.prod(gaps) ** (1 / len(gaps))),
        "elevations": elevations.round(7).tolist(),
        "azimuths": azimuths.round(7).tolist(),
    }


def _class_numbers(ids: ndarray, classes: dict[int, tuple[str, str]]) -> ndarray:
    """Class number of each id, from 1, (T, H, W); 0 for ids without a class."""
    table = np.zeros(2**16, np.uint8)
    table[list(classes)] = np.arange(1, len(classes) + 1)
    return table[ids]


def digest(text: str) -> str:
    """Hash of a text in a content security policy."""
    return "sha256-" + _base64(hashlib.sha256(text.encode()).digest())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
