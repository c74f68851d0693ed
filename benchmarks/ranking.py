"""Which distance tells real scans from simulated, generated and damaged ones, and grows with the damage.

    python benchmarks/ranking.py choosing --real SHARED/real --out choosing      # may be looked at as often as one likes
    python benchmarks/ranking.py hidden --real SHARED/real --out hidden          # once, when everything is chosen

Written down before the first run.

**Damage.** The 56 kinds of `damage.py` at three levels, of which 28 choose and 28 are hidden. The half `choosing`
measures its 28 kinds on scenes of simulator seed 1701 and on the real drives odometry 00, raw 0005 and object. The half
`hidden` measures all 56, the hidden ones apart, on scenes of seed 1702 and on KITTI-360 0000, raw 0048 and odometry 08.

d_0 is the distance of undamaged scans from the reference, d_1 to d_3 that of the same scans with the damage of a level.
Simulated: 96 scans of 64 x 1024 from 96 others. Real: the scans of a half in two at random, the mean over 10 draws.
The floor is the distance of two sets of undamaged scans of the same sizes, drawn at random 100 times.

- A kind **grows** where d_0 < d_1 < d_2 < d_3.
- A level is **seen** where its distance is above all 100 floors.
- A kind **passes** where it grows and its last level is seen.
- The headline passes where all hidden kinds pass on simulated scans, and nine of ten on the few real ones.

**Choice.** Candidates: hand-made features of 1, 2, 4 or 8 bands of rows with 0, 4, 8 or 16 sectors of azimuth, scaled by
fixed numbers or by the spread of the real set, under KID or the Frechet distance. Chosen is the one of which most of
the 28 kinds pass on simulated and on real scans together; of equal ones that which sees more levels, then the simpler.
Beside it: the shipped network, the same with random weights, JSD and MMD.

**Ranking.** At 32 x 256, the size of the model `street`, KID from the held-out real scans must rise along: other real
drives, simulated scans (seed 1702, 128), 128 samples of `street` (seed 1) of 32 evaluations, of 1 evaluation, shuffled
pixels, noise. In the half `choosing` the held-out drives are odometry 00 and object, the other one is raw 0005; in the
half `hidden` they are KITTI-360 0000, and the others are all that choosing had, raw 0048 and odometry 08.

**Sizes.** KID is the headline where it sees more levels than Frechet from as many scans: simulated scans of 32 x 256,
the 28 hidden kinds, 125 to 2,000 scans a side.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from damage import CHOOSING, HIDDEN, KINDS, damaged
from torch import Tensor

from r2flow.data.sources import Reading, SimulatedScans
from r2flow.files import atomic_write
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.metrics.birds_eye import birds_eye_histogram, js_distance
from r2flow.metrics.extractors import load_extractor
from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.extractors.embedded import Embedded
from r2flow.metrics.fidelity import controls
from r2flow.metrics.frechet import distance_from_roots
from r2flow.metrics.kid import cubic_mmd
from r2flow.metrics.scans import Scans
from r2flow.noise import generator
from r2flow.reports.fidelity import load_scans
from r2flow.sampling import sample

SENSOR = SENSORS["hdl64e"]
SEEDS = {"choosing": 1701, "hidden": 1702}
SIMULATED, SAMPLED = 96, 128  # scans of a set
BESIDE = 32  # scans of a set, for the other metrics
FLOORS, DRAWS = 100, 10
REAL = {
    "choosing": ("odometry/sequences/00", "raw/2011_09_26/2011_09_26_drive_0005_sync", "object"),
    "hidden": ("kitti360", "raw/2011_09_26/2011_09_26_drive_0048_sync", "odometry/sequences/08"),
}
# Kinds that mix the scans of a set: done to every drawn half of the real scans anew. The others are done to each scan.
MIXING = (
    "joined from two scans", "pixels of other scans", "faded to another scan", "faded to the mean scan",
    "repeated scans", "one scene favoured", "scans of noise", "scans of shuffled pixels",
    "reflectance of another scan",
)  # fmt: skip

Rows = Callable[[np.ndarray], Tensor]  # of images
Distance = Callable[[Tensor, Tensor], float]


def frechet(x: Tensor, y: Tensor) -> float:
    """Frechet distance of two sets of rows, fewer than columns or not."""
    sides = [((z.double() - z.double().mean(0)) / (len(z) - 1) ** 0.5).T for z in (x, y)]
    return distance_from_roots(x.double().mean(0), sides[0], y.double().mean(0), sides[1])


def jsd(x: Tensor, y: Tensor) -> float:
    return js_distance(x.sum(0).numpy(), y.sum(0).numpy())


def mmd(x: Tensor, y: Tensor) -> float:
    """Unbiased squared MMD of the bird's-eye histograms."""
    p, q = (z / z.sum(1, keepdim=True).clamp(min=1) for z in (x, y))
    kernels = [torch.expm1(-2 * torch.cdist(a, b).square()) for a, b in ((p, p), (q, q), (p, q))]
    within = sum(k.sum() / (len(k) * (len(k) - 1)) for k in kernels[:2])
    return float(within - 2 * kernels[2].mean())


def of_network(extractor: Extractor, sensor: Sensor = SENSOR) -> Rows:
    def rows(images: np.ndarray) -> Tensor:
        parts = torch.from_numpy(np.ascontiguousarray(images)).split(4)
        found = torch.cat([extractor.features(Scans(part, sensor)) for part in parts])
        return found[found.isfinite().all(1)]

    return rows


def from_above(images: np.ndarray) -> Tensor:
    scans = Scans(torch.from_numpy(np.ascontiguousarray(images)), SENSOR)
    return torch.from_numpy(np.stack([birds_eye_histogram(points.numpy()).ravel() for points in scans.points]))


HEADLINE: Mapping[str, Distance] = {"frechet": frechet, "kid": cubic_mmd}


def beside() -> dict[str, tuple[Rows, Mapping[str, Distance]]]:
    """The other metrics: how a set becomes rows, and the distances of these."""
    return {
        "embedded": (of_network(load_extractor("embedded")), HEADLINE),
        "embedded, random weights": (of_network(Embedded.random()), HEADLINE),
        "bird's eye": (from_above, {"jsd": jsd, "mmd_unbiased": mmd}),
    }


def halves(n: int, times: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for k in range(times):
        order = generator(0, "shuffle", k).permutation(n)
        yield order[: n // 2], order[n // 2 :]


def verdict(floors: Sequence[float], d: Sequence[float]) -> dict[str, Any]:
    """Whether distances d_0 to d_3 grow, and which levels are seen."""
    seen = [bool(x > max(floors)) for x in d[1:]]
    grows = all(a < b for a, b in pairwise(d))
    return {"d": list(d), "floor": max(floors), "grows": grows, "seen": seen, "passes": grows and seen[-1]}


def on_simulated(half: str, kinds: Sequence[str], others: bool) -> Iterator[dict[str, Any]]:
    """A row for each kind and metric."""
    images = simulated(SEEDS[half], 2 * SIMULATED)
    reference, judged = images[:SIMULATED], images[SIMULATED:]
    ways = {"handcrafted": (of_network(load_extractor("handcrafted")), HEADLINE), **(beside() if others else {})}
    sizes = {name: (SIMULATED if name == "handcrafted" else BESIDE) for name in ways}
    sets = {name: (rows(reference[: sizes[name]]), rows(judged[: sizes[name]])) for name, (rows, _) in ways.items()}
    if others:
        sets["handcrafted, as few"] = tuple(part[:BESIDE] for part in sets["handcrafted"])
    floors = {}
    for name, (a, b) in sets.items():
        both, few = torch.cat([a, b]), FLOORS if name == "handcrafted" else FLOORS // 4
        for measure, d in ways.get(name, ways["handcrafted"])[1].items():
            floors[name, measure] = [d(both[i], both[j]) for i, j in halves(len(both), few)]
    for kind in kinds:
        levels = [damaged(kind, judged, level, SEEDS[half]) for level in KINDS[kind].levels]
        found = {name: [rows(x[: sizes[name]]) for x in levels] for name, (rows, _) in ways.items()}
        if others:
            found["handcrafted, as few"] = [x[:BESIDE] for x in found["handcrafted"]]
        for name, measure in floors:
            a, b = sets[name]
            distance = ways.get(name, ways["handcrafted"])[1][measure]
            d = [distance(a, x) for x in (b, *found[name])]
            yield {"scans": "simulated", "kind": kind, "by": name, "distance": measure, **verdict(floors[name, measure], d)}


def on_real(half: str, folder: Path, kinds: Sequence[str]) -> Iterator[dict[str, Any]]:
    images = real(folder, REAL[half])
    rows = of_network(load_extractor("handcrafted"))
    known, draws = rows(images), list(halves(len(images), DRAWS))
    floors = {m: [d(known[a], known[b]) for a, b in halves(len(images), FLOORS)] for m, d in HEADLINE.items()}
    for kind in kinds:
        levels = [[known[b] for _, b in draws]]
        for level in KINDS[kind].levels:
            if kind in MIXING:
                levels.append([rows(damaged(kind, images[b], level, SEEDS[half])) for _, b in draws])
            else:
                whole = rows(damaged(kind, images, level, SEEDS[half]))
                levels.append([whole[b] for _, b in draws])
        for measure, distance in HEADLINE.items():
            d = [
                float(np.mean([distance(known[a], x) for (a, _), x in zip(draws, found, strict=True)]))
                for found in levels
            ]
            yield {"scans": "real", "kind": kind, "by": "handcrafted", "distance": measure, **verdict(floors[measure], d)}


def simulated(seed: int, num: int, sensor: Sensor = SENSOR) -> np.ndarray:
    source = SimulatedScans(sensor, seed, range(num))
    return np.stack([source[index] for index in range(num)])


def real(folder: Path, drives: Sequence[str], sensor: Sensor = SENSOR) -> np.ndarray:
    return np.concatenate([load_scans(folder / drive, Reading(sensor))[0] for drive in drives])
