"""Which distance tells real scans from simulated, generated and damaged ones, and grows with the damage.

    python benchmarks/ranking.py choosing --real SHARED/real --out choosing     # may be looked at as often as one likes
    python benchmarks/ranking.py hidden --real SHARED/real --out hidden         # once, when everything is chosen

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

**Choice.** Candidates: hand-made features of 1, 2, 4 or 8 bands of rows with 0, 4, 8 or 16 sectors of azimuth, scaled
by fixed numbers or by the spread of the real set, under KID or the Frechet distance. Chosen is the one of which most of
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
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from damage import CHOOSING, HIDDEN, KINDS, damaged
from torch import Tensor

from r2flow.data.reading import Reading
from r2flow.data.sources import SimulatedScans
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.metrics.birds_eye import birds_eye_histogram, js_distance
from r2flow.metrics.extractors import load_extractor
from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.extractors.embedded import Embedded
from r2flow.metrics.fidelity import controls
from r2flow.metrics.frechet import distance_from_roots
from r2flow.metrics.kid import cubic_mmd
from r2flow.metrics.scans import Scans
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.sampling import sample
from r2flow.models import find_model
from r2flow.noise import generator
from r2flow.reports.fidelity import load_scans
from r2flow.reports.pages import Page, prepare_folder, write_page
from r2flow.reports.tables import table

SENSOR = SENSORS["hdl64e"]
SEEDS = {"choosing": 1701, "hidden": 1702}
SIMULATED, SAMPLED = 96, 128  # scans of a set
SMALL = SENSOR.resized(32, 256)  # for the other metrics and for samples
FLOORS, DRAWS = 100, 10
REAL = {
    "choosing": ("odometry/sequences/00", "raw/2011_09_26/2011_09_26_drive_0005_sync", "object"),
    "hidden": ("kitti360", "raw/2011_09_26/2011_09_26_drive_0048_sync", "odometry/sequences/08"),
}
HELD_OUT = {  # and other drives
    "choosing": (("odometry/sequences/00", "object"), ("raw/2011_09_26/2011_09_26_drive_0005_sync",)),
    "hidden": (("kitti360",), (*REAL["choosing"], *REAL["hidden"][1:])),
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


def from_above(sensor: Sensor) -> Rows:
    def rows(images: np.ndarray) -> Tensor:
        scans = Scans(torch.from_numpy(np.ascontiguousarray(images)), sensor)
        return torch.from_numpy(np.stack([birds_eye_histogram(points.numpy()).ravel() for points in scans.points]))

    return rows


HEADLINE: Mapping[str, Distance] = {"frechet": frechet, "kid": cubic_mmd}


def beside(sensor: Sensor) -> dict[str, tuple[Rows, Mapping[str, Distance]]]:
    """The other metrics: how a set becomes rows, and the distances of these."""
    return {
        "embedded": (of_network(load_extractor("embedded"), sensor), HEADLINE),
        "embedded, random weights": (of_network(Embedded.random(), sensor), HEADLINE),
        "bird's eye": (from_above(sensor), {"jsd": jsd, "mmd_unbiased": mmd}),
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


def on_simulated(
    half: str, kinds: Sequence[str], sensor: Sensor = SENSOR, num: int = SIMULATED, others: bool = False
) -> Iterator[dict[str, Any]]:
    """A row for each kind and metric; that of the other metrics as well where they are asked for."""
    images = simulated(SEEDS[half], 2 * num, sensor)
    reference, judged = images[:num], images[num:]
    size = " x ".join(map(str, sensor.shape))
    ways = {"handcrafted": (of_network(load_extractor("handcrafted"), sensor), HEADLINE)}
    ways |= beside(sensor) if others else {}
    sets = {name: (rows(reference), rows(judged)) for name, (rows, _) in ways.items()}
    floors = {
        (name, measure): [d(*(torch.cat(sets[name])[which] for which in pair)) for pair in halves(2 * num, FLOORS)]
        for name, (_, measures) in ways.items()
        for measure, d in measures.items()
    }
    for kind in kinds:
        levels = [damaged(kind, judged, level, SEEDS[half]) for level in KINDS[kind].levels]
        for name, (rows, measures) in ways.items():
            clean, found = sets[name], [rows(x) for x in levels]
            for measure, distance in measures.items():
                d = [distance(clean[0], x) for x in (clean[1], *found)]
                said = {"scans": f"simulated, {size}", "kind": kind, "by": name, "distance": measure}
                yield said | verdict(floors[name, measure], d)


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
            said = {"scans": "real", "kind": kind, "by": "handcrafted", "distance": measure}
            yield said | verdict(floors[measure], d)


def simulated(seed: int, num: int, sensor: Sensor = SENSOR) -> np.ndarray:
    source = SimulatedScans(sensor, seed, range(num))
    return np.stack([source[index] for index in range(num)])


def real(folder: Path, drives: Sequence[str], sensor: Sensor = SENSOR) -> np.ndarray:
    return np.concatenate([load_scans(folder / drive, Reading(sensor))[0] for drive in drives])


def by_likeness(half: str, folder: Path) -> list[dict[str, Any]]:
    """Distances from the held-out drives of sets that are less and less like them, a row for each metric."""
    drives, others = HELD_OUT[half]
    truth, other = (real(folder, names, SMALL) for names in (drives, others))
    flow = load_checkpoint(find_model("street"))
    drawn = {
        steps: torch.cat([part.images for part in sample(flow, SAMPLED, 1, batch_size=4, steps=steps)]).numpy()
        for steps in (32, 1)
    }
    made = controls(other, SMALL, SAMPLED)
    sets = {
        "other real drives": other, "simulated": simulated(SEEDS["hidden"], SAMPLED, SMALL), "street, 32": drawn[32],
        "street, 1": drawn[1], "shuffled pixels": made["shuffled pixels"], "noise": made["noise"],
    }  # fmt: skip
    found = []
    for name, (rows, measures) in {"handcrafted": (of_network(load_extractor("handcrafted"), SMALL), HEADLINE),
                                   **beside(SMALL)}.items():  # fmt: skip
        known, x = rows(truth), {what: rows(images) for what, images in sets.items()}
        for measure, distance in measures.items():
            floor = float(np.mean([distance(known[a], known[b]) for a, b in halves(len(known), FLOORS)]))
            d = {what: distance(known, one) for what, one in x.items()}
            rises = all(a < b for a, b in pairwise(d.values()))
            found.append({"by": name, "distance": measure, "floor, halves": floor, **d, "holds": rises})
    return found


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Of each metric, how many kinds grow, are seen at their last level and pass, and the levels that are seen."""
    groups: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(str(row[key]) for key in ("half", "scans", "by", "distance")), []).append(row)
    return [
        {
            **dict(zip(("half", "scans", "by", "distance"), key, strict=True)), "kinds": len(own),
            "grow": sum(row["grows"] for row in own), "last level seen": sum(row["seen"][-1] for row in own),
            "pass": sum(row["passes"] for row in own), "levels seen": sum(sum(row["seen"]) for row in own),
        }
        for key, own in groups.items()
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("half", choices=tuple(SEEDS))
    parser.add_argument("--real", type=Path, required=True, help=f"folder of the drives {REAL}")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    half = arguments.half
    prepare_folder(arguments.out)
    rows: list[dict[str, Any]] = []
    kinds = {"choosing": CHOOSING} if half == "choosing" else {"hidden": HIDDEN, "choosing": CHOOSING}
    for of, names in kinds.items():
        parts = [on_simulated(half, names), on_real(half, arguments.real, names)]
        if of == half:
            parts.append(on_simulated(half, names, SMALL, SIMULATED // 2, others=True))
        for row in chain(*parts):
            rows.append({"half": of, **row})
            print(of, row["scans"], row["kind"], row["by"], row["distance"], row["passes"], flush=True)
    ranked = by_likeness(half, arguments.real)
    failed = [row for row in rows if row["by"] == "handcrafted" and not row["passes"]]
    text = [
        "## Damage", table(summary(rows), {key: key for key in summary(rows)[0]}),
        "## Kinds that the headline does not pass", table(failed, {key: key for key in rows[0]}),
        "## Likeness to held-out drives", table(ranked, {key: key for key in ranked[0]}),
    ]  # fmt: skip
    command = shlex.join(["python", "benchmarks/ranking.py", *sys.argv[1:]])
    page = Page(
        "ranking", "Which distance tells real scans from others", text, rows, {}, command, {"simulator": SEEDS[half]}
    )
    print(write_page(page, arguments.out)[-1].read_text())


if __name__ == "__main__":
    main()
