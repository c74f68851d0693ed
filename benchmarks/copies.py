"""Which copies of training scans `r2flow report neighbours` tells from scans that are none.

    python benchmarks/copies.py --training simulated:31 --num 600 --held simulated:32     # half an hour on one core

Copies of training scans, of six kinds and with four levels of range noise on top, and scans that were held out: each
is beside its nearest training scan, and the distance should be the smaller one for the copy. Printed: the area under
the ROC curve (0.5 by chance), and the share of copies that are nearer than all but 1 % of the held-out scans. *pixels*
is the distance without turns, mirror or parts, and its *flagged* the share nearer than a tenth of the usual one, which
is what the report went by before.
"""

import argparse
from collections.abc import Sequence
from functools import partial

import numpy as np

from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanSource
from r2flow.evaluation.measuring import Work
from r2flow.lidar.sensors import SENSORS
from r2flow.reports.neighbours import WAYS, Nearest, described
from r2flow.reports.tables import print_table

SENSOR = SENSORS["hdl64e"].resized(64, 1024)
NOISE = (0.0, 0.03, 0.1, 0.3)  # metres
PIECES = {"cut and joined": 2, "all of it": 3}
KINDS = ("as it is", "turned", "mirrored", "turned, mirrored", *PIECES)


class Copies(ScanSource):
    """Copies of training scans of one kind, (N)."""

    def __init__(self, training: ScanSource, kind: str, noise: float, num: int) -> None:
        self.training, self.kind, self.noise, self.num = training, kind, noise, num

    def __len__(self) -> int:
        return self.num

    @property
    def names(self) -> list[str]:
        return [f"{self.kind} {i}" for i in range(self.num)]

    def subset(self, indices: Sequence[int]) -> "Copies":
        raise NotImplementedError

    def __getitem__(self, index: int) -> np.ndarray:
        draw = np.random.default_rng([index, KINDS.index(self.kind)])
        image = self.one(draw)
        width = image.shape[-1]
        pieces = PIECES.get(self.kind, 1)
        # Joined at random azimuths, no piece under half of its even share.
        ends = [(k + draw.uniform(-0.25, 0.25)) * width / pieces for k in range(1, pieces)]
        for end in ends:
            image[..., int(end) :] = self.one(draw)[..., int(end) :]
        image[0] += self.noise * draw.standard_normal(image[0].shape, dtype=np.float32) * (image[0] > 0)
        return image.clip(min=0)

    def one(self, draw: np.random.Generator) -> np.ndarray:
        """A training scan, turned and mirrored as this kind is."""
        image = self.training[int(draw.integers(len(self.training)))]
        if "turned" in self.kind or self.kind == "all of it":
            image = np.roll(image, draw.integers(1, image.shape[-1]), -1)
        if "mirrored" in self.kind or (self.kind == "all of it" and draw.random() < 0.5):
            image = image[..., ::-1]
        return image.copy()


class Pixels(Nearest):
    """Without turns, mirror and parts; the distance is at full resolution."""

    def __init__(self, scans: ScanSet, work: Work) -> None:
        self.x = np.stack([log_range(scans.source[i]) for i in range(len(scans))])
        self.least = np.full(len(self.x), np.inf)

    def see(self, y: np.ndarray) -> None:
        d = (self.x**2).sum(1)[:, None] + (y**2).sum(1) - 2 * self.x @ y.T
        self.least = np.minimum(self.least, d.clip(min=0).min(1))


def log_range(image: np.ndarray) -> np.ndarray:
    return np.log2(image[0].ravel() + 1) / np.log2(81)


def compared(training: ScanSet, sets: Sequence[ScanSet], work: Work) -> list[dict[str, np.ndarray]]:
    """The distances of every set's scans, by each way."""
    turned, plain = ([kind(one) for one in sets] for kind in (partial(Nearest, work=work, device="cpu"),
                                                             partial(Pixels, work=work)))  # fmt: skip
    first = 0
    for y in described(training, work, "cpu"):
        pixels = np.stack([log_range(training.source[i]) for i in range(first, first + len(y))])
        for one in turned:
            one.approach(y, first, leave_out_itself=False)
        for other in plain:
            other.see(pixels)
        first += len(y)
    return [
        {"pixels": np.sqrt(other.least), **{way: one.distances(way) for way in WAYS}}
        for one, other in zip(turned, plain, strict=True)
    ]


def area(copies: np.ndarray, held: np.ndarray) -> float:
    """Under the ROC curve: the share of pairs in which the copy is the nearer one."""
    return float((copies[:, None] < held).mean() + (copies[:, None] == held).mean() / 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--training", default="simulated:31")
    parser.add_argument("--held", default="simulated:32")
    parser.add_argument("--num", type=int, default=600, help="training scans; half as many are held out")
    parser.add_argument("--copies", type=int, default=64, help="of each kind and level")
    options = parser.parse_args()
    training = open_scans(options.training, Reading(SENSOR, reflectance=False), None, options.num)
    held = open_scans(options.held, Reading(SENSOR, reflectance=False), None, options.num // 2)
    kinds = [(kind, noise) for kind in KINDS for noise in NOISE]
    sets = [ScanSet(kind, Copies(training.source, kind, noise, options.copies), SENSOR) for kind, noise in kinds]
    usual, *found = compared(training, [held, *sets], Work(batch_size=16))
    rows = []
    for (kind, noise), one in zip(kinds, found, strict=True):
        row: dict[str, object] = {"copies": kind, "noise, m": noise}
        row["flagged before"] = f"{(one['pixels'] < 0.1 * np.median(usual['pixels'])).mean():.0%}"
        for way in ("pixels", *WAYS):
            row[f"{way}: area"] = f"{area(one[way], usual[way]):.3f}"
            row[f"{way}: at 1 %"] = f"{(one[way] < np.quantile(usual[way], 0.01)).mean():.0%}"
        rows.append(row)
    print(f"{len(training)} training scans, {len(held)} held out, {options.copies} copies of each")
    print_table(rows, {key: key for key in rows[0]})


if __name__ == "__main__":
    main()
