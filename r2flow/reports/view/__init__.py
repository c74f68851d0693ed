"""Scans in 3-D as a self-contained HTML page: `r2flow view`.

    rays = flow.sensor.rays()
    panels = [Panel(f"sample {i}", image[None], rays) for i, image in enumerate(flow.sample(4).numpy())]
    write_page("scans.html", panels)

The page stores two bytes of range and one of reflectance per pixel, compressed by zlib, and the rays once; the browser
computes the points.
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
from torch import Tensor

from r2flow.errors import InputError, printable
from r2flow.files import write_file
from r2flow.reports.pictures import HEIGHTS, RANGES, class_colours, colours

MOST = 256 * 64 * 1024  # maximum pixels of all images of a page: about 33 MB
STEP = 0.004  # metres per range code: uint16 reaches 262 m with errors of at most 2 mm
CODES = 2**16
SCALES = ("range", "height", "reflectance")  # in the order of `view.js`


class Panel(NamedTuple):
    """One scan of a page, or a sequence of scans for the slider."""

    caption: str
    images: np.ndarray  # range in metres and reflectance, (T, 2 or 1, H, W); 0 for dropped rays
    rays: Tensor  # elevation and azimuth in radians, (2, H, W)
    labels: np.ndarray | None = None  # semantic ids, (T, H, W)
    frames: Sequence[str] = ()  # slider captions


def page(panels: Sequence[Panel], title: str = "r2flow") -> str:
    """One HTML page with a point cloud and a range image per panel, under a shared camera.

    Panels may differ in size and number of frames. The page takes about 50 kB and 130 kB for each image of 64 x 1024.
    Texts in it are never read as HTML.
    """
    count, pixels = sum(len(p.images) for p in panels), sum(p.images[:, 0].size for p in panels)
    if not 0 < pixels <= MOST:
        raise InputError(
            f"a page holds 1 to 256 images of 64 x 1024 (33 MB), or {MOST:,} pixels; found {count} images with "
            f"{pixels:,}. Take fewer scans or frames (--num)."
        )
    sensors: dict[bytes, tuple[int, dict[str, Any]]] = {}
    labelled = [p.labels[p.labels > 0] for p in panels if p.labels is not None]
    classes = class_colours(np.concatenate(labelled), most=255) if labelled else {}
    step = max(STEP, max(float(np.nan_to_num(p.images[:, 0], posinf=0).max(initial=0)) for p in panels) / (CODES - 1))
    scans = []
    for caption, images, rays, labels, _ in panels:
        assert images.shape[1] in (1, 2)
        assert rays.shape == (2, *images.shape[2:]), f"{caption}: images of {images.shape[2:]}, rays of {rays.shape}"
        angles = np.asarray(rays, dtype=np.float64)
        number, _ = sensors.setdefault(angles.tobytes(), (len(sensors), _described(angles)))
        numbers = [None] * len(images) if labels is None else _numbered(labels, classes)
        scans.append({
            "caption": printable(caption), "rays": number,
            "frames": [packed_image(image, step, ids) for image, ids in zip(images, numbers, strict=True)],
            "reflectance": images.shape[1] > 1, "labels": labels is not None,
        })  # fmt: skip
    contents = {
        "scans": scans,
        "rays": [described for _, described in sensors.values()],
        "frames": [printable(frame) for frame in max((p.frames for p in panels), key=len)],
        "metres": step,
        "ranges": RANGES,
        "heights": HEIGHTS,
        "colours": _text(b"".join(colours(name)(np.arange(256), bytes=True).tobytes() for name in SCALES)),
        "classes": [("no class", "#808080"), *classes.values()],
        "legend": list(dict(classes.values()).items()),
        "shown": {"reflectance": any(s["reflectance"] for s in scans), "label": any(s["labels"] for s in scans)},
    }
    # The content security policy allows only this script and this style, by hash.
    part = {name: files(__package__).joinpath(f"view.{name}").read_text("utf-8") for name in ("html", "css", "js")}
    # Only "<" could end the script element.
    data = json.dumps(contents, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return Template(part["html"]).substitute(
        title=html.escape(printable(title)), data=data, style=part["css"], script=part["js"],
        style_hash=_hash(part["css"]), script_hash=_hash(part["js"]),
    )  # fmt: skip


def write_page(path: str | Path, panels: Sequence[Panel], title: str = "r2flow") -> Path:
    write_file(path, page(panels, title))
    return Path(path)


def most_images(shape: Sequence[int]) -> int:
    """Maximum number of images (..., H, W) on a page."""
    return MOST // int(np.prod(shape[-2:]))


def packed_image(image: np.ndarray, step: float, numbers: np.ndarray | None = None) -> str:
    """Encode an image, (2 or 1, H, W), as byte planes of H W each, compressed by zlib, in base64.

    Planes: high and low bytes of range codes, as differences along each row modulo 2^16; optionally reflectance in 255
    levels; optionally class numbers. Code c means c `step` metres, 0 no return.
    """
    r = np.nan_to_num(image[0].astype(np.float64), posinf=0, neginf=0)
    codes = np.where(r > 0, np.clip(np.rint(r / step), 1, CODES - 1), 0).astype(np.int32)
    differences = (np.diff(codes, axis=1, prepend=0) % CODES).astype(">u2")
    planes = [differences.view(np.uint8).reshape(-1, 2).T.tobytes()]
    if len(image) > 1:
        planes.append(np.rint(255 * np.nan_to_num(image[1]).clip(0, 1)).astype(np.uint8).tobytes())
    if numbers is not None:
        planes.append(numbers.astype(np.uint8).tobytes())
    return _text(zlib.compress(b"".join(planes), 6))


def _described(rays: np.ndarray) -> dict[str, Any]:
    """Rays, (2, H, W), as elevations of rows and azimuths of columns, which all sensors have."""
    e, a = rays
    # The geometric mean of the median angles between neighbouring rows and columns, in radians.
    gaps = [float(np.median(np.abs(np.diff(x, axis=axis)))) for axis, x in enumerate((e, a)) if x.shape[axis] > 1]
    spacing = float(np.prod(gaps) ** (1 / len(gaps))) if gaps else 0.01
    angles = {"elevations": e[:, 0].round(7).tolist(), "azimuths": a[0].round(7).tolist()}
    return {"rows": e.shape[0], "columns": e.shape[1], "spacing": spacing, **angles}


def _numbered(ids: np.ndarray, classes: dict[int, tuple[str, str]]) -> np.ndarray:
    """Class number of each id, from 1, (T, H, W); 0 for ids without a class."""
    table = np.zeros(int(max(ids.max(initial=0), *classes, 0)) + 1, np.uint8)
    table[list(classes)] = np.arange(1, len(classes) + 1)
    return table[ids]


def _hash(text: str) -> str:
    return "sha256-" + _text(hashlib.sha256(text.encode()).digest())


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode()
