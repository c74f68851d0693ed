"""56 kinds of damage to sets of range images, at three levels each, the least first.

Two halves: the features of `r2flow.metrics.extractors.handcrafted` were chosen on `CHOOSING`, and judged on `HIDDEN`,
which was never looked at before. Neighbours in the table, which are alike, lie in different halves.
"""

import math
import zlib
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.random import Generator

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.fidelity import controls
from r2flow.noise import generator

EDGE = 0.5  # metres between neighbours in a row: another object

Damage = Callable[[np.ndarray, float, Generator], np.ndarray]


class Kind(NamedTuple):
    """What is done, how much of it, and in which unit."""

    damage: Damage
    levels: tuple[float, float, float]
    unit: str


def damaged(name: str, images: np.ndarray, level: float, seed: int) -> np.ndarray:
    """The images with a kind of damage, (N, 2, H, W); the same draws at every level."""
    return KINDS[name].damage(images.copy(), level, generator(seed, "evaluation", zlib.crc32(name.encode())))


def ranged(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The images with other ranges; beyond the sensor's 1.45 to 80 m and where it is 0 there is no return."""
    kept = (r >= 1.45) & (r <= 80)
    return np.stack([np.where(kept, r, 0), np.where(kept, x[:, 1], 0)], 1).astype(np.float32)


def reflecting(x: np.ndarray, reflectance: np.ndarray) -> np.ndarray:
    """The images with other reflectances, within [0, 1], where a ray returned."""
    x[:, 1] = np.clip(reflectance, 0, 1) * (x[:, 0] > 0)
    return x


def without(x: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """The images without the returns of these pixels, (N, H, W)."""
    return x * ~lost[:, None]


def bent(of: Callable[[np.ndarray, float, Generator], np.ndarray]) -> Damage:
    """Damage from a function of the ranges, (N, H, W), that gives others where a ray returned."""
    return lambda x, level, rng: ranged(x, np.where(x[:, 0] > 0, of(x[:, 0], level, rng), 0))


def relit(of: Callable[[np.ndarray, float, Generator], np.ndarray]) -> Damage:
    """Damage from a function of the reflectances."""
    return lambda x, level, rng: reflecting(x, of(x[:, 1], level, rng))


def losing(of: Callable[[np.ndarray, float, Generator], np.ndarray]) -> Damage:
    """Damage from a function that says which pixels of the images lose their return, (N, H, W)."""
    return lambda x, level, rng: without(x, of(x, level, rng))


def blurred(x: np.ndarray, w: np.ndarray, rows: float, columns: float) -> np.ndarray:
    """G (w x) / G w of (N, H, W), G a Gaussian of so many pixels that wraps in azimuth; w = 1 at returns."""

    def along(q: torch.Tensor, sigma: float, dim: int) -> torch.Tensor:
        if not sigma:
            return q
        reach = math.ceil(3 * sigma)
        taps = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / sigma) ** 2)
        if dim == -1:
            q = torch.nn.functional.pad(q, (reach, reach, 0, 0), mode="circular")
            return torch.nn.functional.conv2d(q, taps[None, None, None])
        return torch.nn.functional.conv2d(q, taps[None, None, :, None], padding=(reach, 0))

    top, bottom = (along(along(torch.from_numpy(q)[:, None], rows, -2), columns, -1) for q in (x * w, w))
    return (top / bottom.clamp(min=1e-6))[:, 0].numpy()


def blur(x: np.ndarray, rows: float, columns: float) -> np.ndarray:
    w = (x[:, 0] > 0).astype(np.float32)
    return ranged(x, blurred(x[:, 0], w, rows, columns) * w)


def relight(x: np.ndarray, sigma: float) -> np.ndarray:
    return reflecting(x, blurred(x[:, 1], (x[:, 0] > 0).astype(np.float32), sigma, sigma))


def median(r: np.ndarray, size: float, rng: Generator) -> np.ndarray:
    """Median over the returns among 3 rows and `size` columns."""
    half = int(size) // 2
    rows = np.pad(r, ((0, 0), (1, 1), (0, 0)))
    around = [np.roll(rows[:, k : k + r.shape[1]], j, -1) for k in range(3) for j in range(-half, half + 1)]
    out = np.empty_like(r)
    for n in range(len(r)):
        stack = np.stack([a[n] for a in around])
        stack[stack == 0] = np.nan
        out[n] = np.nanmedian(np.where(r[n] > 0, stack, 0), axis=0)
    return out


def edges(r: np.ndarray) -> np.ndarray:
    """Returns whose right neighbour lies on another object."""
    other = np.roll(r, -1, -1)
    return (r > 0) & (other > 0) & (np.abs(r - other) > EDGE)


def flying(r: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    """Returns at edges lie anywhere between both objects."""
    chosen, place = edges(r) & (rng.random(r.shape) < share), rng.random(r.shape)
    return np.where(chosen, r + place * (np.roll(r, -1, -1) - r), r)


def lost_beams(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    order = rng.random((len(x), x.shape[2])).argsort(1)
    return np.broadcast_to((order < round(share * x.shape[2]))[:, :, None], x[:, 0].shape)


def lost_blocks(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    """Cells of a grid of 8 x 32 of the image."""
    cells = rng.random((len(x), 8, 32)) < share
    return cells.repeat(x.shape[2] // 8, 1).repeat(x.shape[3] // 32, 2)


def lost_wedge(x: np.ndarray, degrees: float, rng: Generator) -> np.ndarray:
    start = rng.integers(x.shape[3], size=(len(x), 1))
    inside = (np.arange(x.shape[3]) - start) % x.shape[3] < degrees / 360 * x.shape[3]
    return np.broadcast_to(inside[:, None], x[:, 0].shape)


def filled(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    """Lost rays get the nearest return to the left of their row."""
    returned = x[:, 0] > 0
    place = np.where(returned, np.arange(x.shape[3]), -1)
    source = np.maximum.accumulate(place, axis=-1)
    there = np.take_along_axis(x, np.maximum(source, 0)[:, None].repeat(2, 1), -1)
    chosen = ~returned & (source >= 0) & (rng.random(returned.shape) < share)
    return np.where(chosen[:, None], there, x)


def in_the_air(x: np.ndarray, share: float, rng: Generator, r: Callable[[tuple[int, ...]], np.ndarray]) -> np.ndarray:
    """Rays with a return of range r(shape) and of reflectance 0.1."""
    chosen = rng.random(x[:, 0].shape) < share
    return np.where(chosen[:, None], np.stack([r(chosen.shape), np.full(chosen.shape, 0.1)], 1), x).astype(np.float32)


def sky(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    """Lost rays return from 50 m."""
    return np.where((x[:, :1] > 0), x, in_the_air(x, share, rng, lambda shape: np.full(shape, 50.0)))


def moved_rows(x: np.ndarray, rows: float, rng: Generator) -> np.ndarray:
    """Each pixel shows what lies so many rows below it; the lowest rows are empty."""
    out = np.zeros_like(x)
    out[:, :, : -int(rows)] = x[:, :, int(rows) :]
    return out


def tilted(x: np.ndarray, rows: float, rng: Generator) -> np.ndarray:
    """Rows moved by `rows` cos(azimuth), the nearest one: as if the sensor leant."""
    h, w = x.shape[2:]
    source = np.arange(h)[:, None] + np.rint(rows * np.cos(2 * np.pi * np.arange(w) / w)).astype(int)
    inside = (source >= 0) & (source < h)
    return x[:, :, np.clip(source, 0, h - 1), np.arange(w)] * inside


def jittered_rows(x: np.ndarray, columns: float, rng: Generator) -> np.ndarray:
    by = rng.integers(-int(columns), int(columns) + 1, size=(len(x), 1, x.shape[2], 1))
    return np.take_along_axis(x, (np.arange(x.shape[3]) + by) % x.shape[3], -1)


def swapped_rows(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    """Rows 2k and 2k + 1 change places, others in each scan."""
    h = x.shape[2]
    swap = np.repeat(rng.random((len(x), h // 2)) < share, 2, axis=1)
    source = np.where(swap, np.arange(h) ^ 1, np.arange(h))
    return np.take_along_axis(x, source[:, None, :, None], 2)


def shuffled_columns(x: np.ndarray, window: float, rng: Generator) -> np.ndarray:
    """Columns change places within windows."""
    w = x.shape[3]
    order = (np.arange(w) // int(window) + rng.random((len(x), w)) * 0.999).argsort(1)
    return np.take_along_axis(x, order[:, None, None], -1)


def stretched(x: np.ndarray, by: float, rng: Generator) -> np.ndarray:
    """Azimuth times `by` about the middle column; what leaves the image at the ends is lost."""
    w = x.shape[3]
    return x[..., np.rint((np.arange(w) - w // 2) / by + w // 2).astype(int) % w]


def repeated_rows(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    """Rows become copies of the row above."""
    h = x.shape[2]
    copied = rng.random((len(x), h)) < share
    source = np.where(copied, np.maximum(np.arange(h) - 1, 0), np.arange(h))
    return np.take_along_axis(x, source[:, None, :, None], 2)


def pasted(x: np.ndarray, times: float, rng: Generator) -> np.ndarray:
    """Patches of a quarter of the rows and a sixteenth of the columns, from another azimuth of the same scan."""
    (n, _, h, w), out = x.shape, x.copy()
    draws = rng.integers([h - h // 4 + 1, w, w], size=(16, n, 3))
    for k in range(int(times)):
        for i, (top, to, source) in enumerate(draws[k]):
            rows = slice(top, top + h // 4)
            columns = np.arange(w // 16)
            out[i, :, rows, (to + columns) % w] = x[i, :, rows, (source + columns) % w]
    return out


def some(x: np.ndarray, share: float, rng: Generator, other: np.ndarray) -> np.ndarray:
    """The first scans in a random order replaced by those of another set."""
    chosen = rng.permutation(len(x)) < round(share * len(x))
    return np.where(chosen[:, None, None, None], other, x)


def joined(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    """Half of the columns, beginning anywhere, of the next scan."""
    half = (np.arange(x.shape[3]) - rng.integers(x.shape[3], size=(len(x), 1))) % x.shape[3] < x.shape[3] // 2
    return some(x, share, rng, np.where(half[:, None, None], np.roll(x, 1, 0), x))


def pixels_of_others(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    return np.where(rng.random(x[:, :1].shape) < share, np.roll(x, 1, 0), x)


def faded(x: np.ndarray, share: float, other: np.ndarray) -> np.ndarray:
    """(1 - share) x + share other, where both have a return."""
    both = (x[:, :1] > 0) & (other[:, :1] > 0)
    return np.where(both, (1 - share) * x + share * other, x).astype(np.float32)


def mean_scan(x: np.ndarray) -> np.ndarray:
    return np.broadcast_to(x.sum(0) / np.maximum((x[:, :1] > 0).sum(0), 1), x.shape)


def repeated(x: np.ndarray, times: float, rng: Generator) -> np.ndarray:
    """Every `times`-th scan, so often that there are as many as before."""
    return np.resize(x[:: int(times)], x.shape)


def controlled(name: str) -> Damage:
    """Some scans replaced by a control made of the set."""

    def damage(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
        sensor = SENSORS["hdl64e"].resized(*x.shape[2:])
        return some(x, share, rng, controls(x, sensor, len(x), int(rng.integers(2**31)))[name])

    return damage


def normal(rng: Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.standard_normal(shape, dtype=np.float32)


def beam(rng: Generator, r: np.ndarray) -> np.ndarray:
    """A normal number for each row, the same in all scans."""
    return normal(rng, (1, r.shape[1], 1))


def azimuths(r: np.ndarray) -> np.ndarray:
    return 2 * np.pi * np.arange(r.shape[-1]) / r.shape[-1]


def patches(rng: Generator, r: np.ndarray) -> np.ndarray:
    """A normal number for each patch of 1 x 4 pixels."""
    return normal(rng, (*r.shape[:2], r.shape[2] // 4)).repeat(4, 2)


def checkers(r: np.ndarray) -> np.ndarray:
    return (-1.0) ** np.add.outer(np.arange(r.shape[1]), np.arange(r.shape[2]))


def octaves(r: np.ndarray, steps: float, rng: Generator) -> np.ndarray:
    """Range in so many equal steps of log(r + 1) up to 80 m."""
    return np.exp(np.rint(np.log(r + 1) / np.log(81) * steps) / steps * np.log(81)) - 1


def outliers(r: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    return np.where(rng.random(r.shape) < share, rng.uniform(2, 60, r.shape), r)


def sharpened(r: np.ndarray, amount: float, rng: Generator) -> np.ndarray:
    return r + amount * (r - blurred(r, (r > 0).astype(np.float32), 1, 1))


def swapped_reflectance(x: np.ndarray, share: float, rng: Generator) -> np.ndarray:
    """Reflectance of a pixel elsewhere in the same row."""
    source = np.where(rng.random(x[:, 1].shape) < share, rng.integers(x.shape[3], size=x[:, 1].shape), -1)
    there = np.take_along_axis(x[:, 1], np.maximum(source, 0), -1)
    return reflecting(x, np.where(source < 0, x[:, 1], there))


SHARES = (0.1, 0.3, 1.0)
KINDS: Mapping[str, Kind] = {
    # ranges
    "noise of range": Kind(bent(lambda r, s, g: r + s * normal(g, r.shape)), (0.03, 0.1, 0.3), "metres"),
    "noise that grows with range": Kind(
        bent(lambda r, s, g: r * (1 + s * normal(g, r.shape))), (0.003, 0.01, 0.03), "of range"
    ),
    "offset of each beam": Kind(bent(lambda r, s, g: r + s * beam(g, r)), (0.03, 0.1, 0.3), "metres"),
    "gain of each beam": Kind(bent(lambda r, s, g: r * (1 + s * beam(g, r))), (0.003, 0.01, 0.03), "of range"),
    "range in steps": Kind(bent(lambda r, s, g: np.rint(r / s) * s), (0.1, 0.3, 1.0), "metres"),
    "log-range in steps": Kind(bent(octaves), (512, 128, 32), "steps"),
    "range too long": Kind(bent(lambda r, s, g: r * s), (1.02, 1.06, 1.2), "times"),
    "range offset": Kind(bent(lambda r, s, g: r + s), (0.1, 0.3, 1.0), "metres"),
    "outliers": Kind(bent(outliers), (0.001, 0.01, 0.1), "of returns"),
    "flying pixels": Kind(bent(flying), SHARES, "of edges"),
    "blur": Kind(lambda x, s, g: blur(x, s, s), (0.5, 1.0, 2.0), "pixels"),
    "blur along rows": Kind(lambda x, s, g: blur(x, 0, s), (0.5, 1.0, 2.0), "pixels"),
    "blur across rows": Kind(lambda x, s, g: blur(x, s, 0), (0.5, 1.0, 2.0), "pixels"),
    "median": Kind(bent(median), (1, 3, 7), "columns"),
    "sharpened": Kind(bent(sharpened), SHARES, "of what blur takes"),
    "checkerboard": Kind(bent(lambda r, s, g: r + s * checkers(r)), (0.03, 0.1, 0.3), "metres"),
    "noise of patches": Kind(bent(lambda r, s, g: r + s * patches(g, r)), (0.03, 0.1, 0.3), "metres"),
    "ripple of 8 columns": Kind(
        bent(lambda r, s, g: r * (1 + s * np.sin(azimuths(r) * r.shape[-1] / 8))), (0.003, 0.01, 0.03), "of range"
    ),
    "longer ahead": Kind(bent(lambda r, s, g: r * (1 - s * np.cos(azimuths(r)))), (0.02, 0.06, 0.2), "of range"),
    "tilt": Kind(tilted, (1, 2, 4), "rows"),
    # returns
    "lost pixels": Kind(losing(lambda x, s, g: g.random(x[:, 0].shape) < s), (0.01, 0.05, 0.2), "of pixels"),
    "lost beams": Kind(losing(lost_beams), (1 / 32, 1 / 8, 1 / 4), "of beams"),
    "lost blocks": Kind(losing(lost_blocks), (0.01, 0.05, 0.2), "of 256 blocks"),
    "lost wedge": Kind(losing(lost_wedge), (5, 15, 45), "degrees"),
    "far returns lost": Kind(losing(lambda x, s, g: x[:, 0] > s), (50, 35, 20), "metres"),
    "near returns lost": Kind(losing(lambda x, s, g: x[:, 0] < s), (4, 6, 10), "metres"),
    "losses filled": Kind(filled, SHARES, "of losses"),
    "losses at edges": Kind(losing(lambda x, s, g: edges(x[:, 0]) & (g.random(x[:, 0].shape) < s)), SHARES, "of edges"),
    "sky filled": Kind(sky, (0.02, 0.1, 0.5), "of losses"),
    "snow": Kind(lambda x, s, g: in_the_air(x, s, g, lambda n: g.uniform(2, 8, n)), (0.001, 0.005, 0.02), "of pixels"),
    # places
    "rows moved up": Kind(moved_rows, (1, 2, 4), "rows"),
    "rows jittered": Kind(jittered_rows, (1, 3, 10), "columns"),
    "rows swapped": Kind(swapped_rows, SHARES, "of pairs"),
    "columns shuffled": Kind(shuffled_columns, (2, 4, 16), "columns of a window"),
    "turned": Kind(lambda x, s, g: np.roll(x, round(s / 360 * x.shape[-1]), -1), (5, 15, 45), "degrees"),
    "mirrored": Kind(lambda x, s, g: some(x, s, g, x[..., ::-1]), (0.25, 0.5, 1.0), "of scans"),
    "stretched": Kind(stretched, (1.02, 1.1, 1.3), "times"),
    "columns repeated": Kind(lambda x, s, g: x[..., np.arange(x.shape[-1]) // int(s) * int(s)], (2, 4, 8), "times"),
    "rows repeated": Kind(repeated_rows, (0.1, 0.3, 0.5), "of rows"),
    "patches pasted": Kind(pasted, (1, 4, 16), "patches"),
    # scans and sets
    "joined from two scans": Kind(joined, (0.25, 0.5, 1.0), "of scans"),
    "pixels of other scans": Kind(pixels_of_others, (0.01, 0.05, 0.3), "of pixels"),
    "faded to another scan": Kind(lambda x, s, g: faded(x, s, np.roll(x, 1, 0)), (0.05, 0.2, 0.5), "of the other"),
    "faded to the mean scan": Kind(lambda x, s, g: faded(x, s, mean_scan(x)), (0.05, 0.2, 0.5), "of the mean"),
    "repeated scans": Kind(repeated, (2, 4, 8), "copies"),
    "one scene favoured": Kind(lambda x, s, g: some(x, s, g, x[:1].repeat(len(x), 0)), (0.1, 0.3, 0.6), "of scans"),
    "scans of noise": Kind(controlled("noise"), (0.05, 0.1, 0.3), "of scans"),
    "scans of shuffled pixels": Kind(controlled("shuffled pixels"), (0.05, 0.1, 0.3), "of scans"),
    # reflectances
    "noise of reflectance": Kind(relit(lambda q, s, g: q + s * normal(g, q.shape)), (0.02, 0.06, 0.2), "of full scale"),
    "reflectance too dark": Kind(relit(lambda q, s, g: q * s), (0.95, 0.85, 0.6), "times"),
    "reflectance in steps": Kind(relit(lambda q, s, g: np.rint(q * s) / s), (32, 16, 6), "steps"),
    "reflectance of each beam": Kind(relit(lambda q, s, g: q * np.exp(s * beam(g, q))), (0.05, 0.15, 0.4), "log-gain"),
    "reflectance blurred": Kind(lambda x, s, g: relight(x, s), (0.5, 1.0, 2.0), "pixels"),
    "reflectance of another scan": Kind(
        lambda x, s, g: some(x, s, g, reflecting(x.copy(), np.roll(x[:, 1], 1, 0))), SHARES, "of scans"
    ),
    "reflectance faded to its mean": Kind(
        relit(lambda q, s, g: q + s * (q.mean((1, 2), keepdims=True) - q)), SHARES, "of the mean"
    ),
    "reflectance swapped in rows": Kind(swapped_reflectance, (0.05, 0.2, 1.0), "of pixels"),
}  # fmt: skip
CHOOSING, HIDDEN = tuple(KINDS)[::2], tuple(KINDS)[1::2]
