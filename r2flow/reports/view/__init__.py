"""Scans in 3-D as one HTML page, which needs no network: `r2flow view`.

    images = flow.sample(4)
    Path("scans.html").write_text(page(images, flow.sensor.rays()))

The page holds what a scanner measures, not points: for each pixel two bytes of range and one of reflectance, packed by
zlib, and the rays once. The browser multiplies the two. `view.js` draws, `view.css` says how it looks.
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
from typing import Any

import numpy as np
from torch import Tensor

from r2flow.errors import InputError, printable
from r2flow.files import atomic_write
from r2flow.reports.pictures import HEIGHTS, RANGES, class_colours, colours

MOST = 256 * 64 * 1024  # pixels of a page, all images together: about 33 MB
STEP = 0.004  # metres of a range code: uint16 reaches 262 m, and a range is off by 2 mm at most
CODES = 2**16
SCALES = ("range", "height", "reflectance")  # as `view.js` numbers them

Images = np.ndarray | Tensor
Rays = np.ndarray | Tensor


def page(
    images: Sequence[Images] | Images,
    rays: Rays | Sequence[Rays],
    captions: Sequence[str] = (),
    *,
    frames: Sequence[str] = (),
    labels: Sequence[np.ndarray | None] = (),
    title: str = "r2flow",
) -> str:
    """One HTML page with a point cloud and a range image of each scan, under one camera.

    Args:
        images: Range in metres and reflectance of each scan, (2 or 1, H, W), 0 where a ray was dropped; or of each
            frame of it, (T, 2 or 1, H, W), which a slider goes through. Scans may differ in size and number of frames.
        rays: Elevation and azimuth in radians, (2, H, W), of all scans, or of each.
        captions: Of each scan; its number if left out.
        frames: What the slider says at each frame.
        labels: Semantic id of each pixel of a scan, (H, W) or (T, H, W); None for a scan without.

    Returns:
        The page, about 50 kB and 130 kB for each image of 64 x 1024. Texts in it are never read as HTML.

    Raises:
        InputError: no scan, or more than `MOST` pixels.
    """
    stacks = [_frames_of(one) for one in images]
    count, pixels = sum(map(len, stacks)), sum(stack[:, 0].size for stack in stacks)
    if not 0 < pixels <= MOST:
        raise InputError(
            f"a page holds 1 to 256 images of 64 x 1024 (33 MB), or {MOST:,} pixels; found {count} images with "
            f"{pixels:,}. Take fewer scans or frames (--num)."
        )
    shared = isinstance(rays, np.ndarray | Tensor)
    each_rays = [np.asarray(one, dtype=np.float64) for one in ([rays] * len(stacks) if shared else rays)]
    each_labels = [None if one is None else np.asarray(one) for one in labels or [None] * len(stacks)]
    each_caption = captions or range(len(stacks))
    sensors: dict[bytes, tuple[int, dict[str, Any]]] = {}
    given = [ids[ids > 0] for ids in each_labels if ids is not None]
    classes = class_colours(np.concatenate(given), most=255) if given else {}
    step = max(STEP, max(float(stack[:, 0].max(initial=0)) for stack in stacks) / (CODES - 1))
    scans = []
    for stack, seen, ids, caption in zip(stacks, each_rays, each_labels, each_caption, strict=True):
        assert seen.shape == (2, *stack.shape[2:]), f"{caption}: images of {stack.shape[2:]}, rays of {seen.shape}"
        number, _ = sensors.setdefault(seen.tobytes(), (len(sensors), _described(seen)))
        numbers = None if ids is None else _numbered(ids, stack, classes)
        packed = [packed_image(image, step, None if numbers is None else numbers[t]) for t, image in enumerate(stack)]
        scans.append({
            "caption": printable(str(caption)), "rays": number, "frames": packed,
            "reflectance": stack.shape[1] > 1, "labels": ids is not None,
        })  # fmt: skip
    contents = {
        "scans": scans,
        "rays": [described for _, described in sensors.values()],
        "frames": [printable(str(frame)) for frame in frames],
        "metres": step,
        "ranges": RANGES,
        "heights": HEIGHTS,
        "colours": _text(b"".join(colours(name)(np.arange(256), bytes=True).tobytes() for name in SCALES)),
        "classes": [("no class", "#808080"), *classes.values()],
        "legend": list(dict(classes.values()).items()),
        "shown": {"reflectance": any(s["reflectance"] for s in scans), "label": any(s["labels"] for s in scans)},
    }
    return _filled(contents, title)


def most_images(shape: Sequence[int]) -> int:
    """How many images of (..., H, W) a page holds."""
    return MOST // int(np.prod(shape[-2:]))


def write_page(path: str | Path, *args: Any, **options: Any) -> Path:
    """Write the `page` of these arguments, whole or not at all."""
    content = page(*args, **options)
    with atomic_write(path, "w") as file:
        file.write(content)
    return Path(path)


def packed_image(image: np.ndarray, step: float, numbers: np.ndarray | None = None) -> str:
    """An image as base64 of zlib of planes of bytes, H W each.

    High and low byte of the range codes, each row as differences from its left neighbour modulo 2^16; reflectance in
    255 levels, where there is one; the number of the class, where there is one. Code c is c `step` metres, 0 no return.

    Args:
        image: (2 or 1, H, W).
        numbers: (H, W) uint8.
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


def _frames_of(images: Images) -> np.ndarray:
    """(T, 2 or 1, H, W) of one scan."""
    stack = np.asarray(images, dtype=np.float32)
    assert stack.shape[-3] in (1, 2), stack.shape
    return stack.reshape(-1, *stack.shape[-3:])


def _described(rays: np.ndarray) -> dict[str, Any]:
    """Rays as an elevation of each row and an azimuth of each column; pixel by pixel where that is not enough."""
    e, a = rays
    size = {"rows": e.shape[0], "columns": e.shape[1], "spacing": _spacing(rays)}
    if (e == e[:, :1]).all() and (a == a[:1]).all():
        return {**size, "elevations": e[:, 0].round(7).tolist(), "azimuths": a[0].round(7).tolist()}
    return {**size, "pixels": _text(rays.astype("<f4").tobytes())}


def _spacing(rays: np.ndarray) -> float:
    """Usual angle between neighbouring rays in radians: of rows and columns the geometric mean."""
    e, a = rays
    gaps = [float(np.median(np.abs(np.diff(one, axis=axis)))) for axis, one in enumerate((e, a)) if one.shape[axis] > 1]
    return float(np.prod(gaps) ** (1 / len(gaps))) if gaps else 0.01


def _numbered(ids: np.ndarray, stack: np.ndarray, classes: dict[int, tuple[str, str]]) -> np.ndarray:
    """The place of each id among the classes, from 1 on, (T, H, W); 0 for none."""
    table = np.zeros(int(max(ids.max(initial=0), *classes, 0)) + 1, np.uint8)
    table[list(classes)] = np.arange(1, len(classes) + 1)
    return np.broadcast_to(table[ids], (len(stack), *stack.shape[2:]))


def _filled(contents: dict[str, Any], title: str) -> str:
    # The policy lets the one script and the one style run, by their hashes.
    part = {name: files(__package__).joinpath(f"view.{name}").read_text("utf-8") for name in ("html", "css", "js")}
    # Within a script element only "<" could end it, or begin another one.
    data = json.dumps(contents, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return Template(part["html"]).substitute(
        title=html.escape(printable(title)), data=data, style=part["css"], script=part["js"],
        style_hash=_hash(part["css"]), script_hash=_hash(part["js"]),
    )  # fmt: skip


def _hash(text: str) -> str:
    return "sha256-" + _text(hashlib.sha256(text.encode()).digest())


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode()
