"""Train the embedded extractor on simulated scans with their labels: the same seed gives the same weights, bit for bit.

    python benchmarks/train_extractor.py --seed 7001 --out embedded.safetensors

Without --view, sensors and sizes take turns, as for the shipped weights. --out and --workers change no weight.
"""

import argparse
import hashlib
import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import r2flow
from r2flow.files import atomic_write
from r2flow.hashing import state_hash
from r2flow.lidar.labels import LABELS
from r2flow.lidar.sensors import SENSORS, Sensor, build_sensor
from r2flow.metrics.extractors.embedded import CLASSES, REFLECTANCE, SegmentationNetwork, inputs
from r2flow.metrics.scans import Scans
from r2flow.noise import generator, seed_torch
from r2flow.progress import Bar
from r2flow.reports.pages import prepare_folder
from r2flow.reports.tables import print_table
from r2flow.simulator import simulate
from r2flow.stages.base import learning_rate_factor

IGNORED = -1  # class of pixels that are not learned from
LEARNING_RATE, WARMUP, WEIGHT_DECAY = 2e-3, 100, 1e-2
RANGE_ALONE = 1 / 3  # share of scans that are shown without reflectance
# Share of scans with noise on their ranges, and its standard deviation in metres, log-uniform. A network that only ever
# sees the simulator's few millimetres of noise takes a wall with 3 cm of it for grass.
NOISY, NOISE = 1 / 2, (0.003, 1.0)
MOMENTUM = 0.02  # of batch norm's averages, slow because sensors take turns
COUNTED = 32  # scans that the frequencies of classes are counted on
HELD_OUT, HELD_OUT_FROM = 16, 2**32  # scenes of each sensor to judge on, and where they begin: beyond any training's

# Sensors take turns: the paper's image every third step.
VIEWS: tuple[str, ...] = (
    "hdl64e 64x1024", "hdl64e 32x256", "hdl64e_rings 64x1024", "hdl64e 64x1024", "hdl32e 32x1024", "vlp16 16x1024",
)  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """The settings that the weights depend on.

    Attributes:
        seed: Of scenes, initial weights and augmentation.
        steps: Optimiser steps.
        batch_size: Scans of a step.
        views: Sensors and image sizes, which take turns.
    """

    seed: int = 0
    steps: int = 1500
    batch_size: int = 4
    views: tuple[str, ...] = VIEWS

    def sensor(self, step: int) -> Sensor:
        """Whose turn it is."""
        name, _, size = self.views[step % len(self.views)].partition(" ")
        rows, columns = (int(number) for number in size.split("x"))
        return build_sensor(name, rows, columns)

    def command(self) -> str:
        """The command that trains them."""
        words = ["python", "benchmarks/train_extractor.py", "--seed", self.seed, "--steps", self.steps]
        words += ["--batch-size", self.batch_size]
        if self.views != VIEWS:
            words += [word for view in self.views for word in ("--view", view)]
        return shlex.join(map(str, words))

    def simulator(self) -> str:
        """The simulator's version: 12 digits of the SHA-256 of one scan."""
        scan = simulate(SENSORS["hdl64e"], self.seed, 0)
        return hashlib.sha256(scan.image.tobytes() + scan.labels.tobytes()).hexdigest()[:12]

    def notes(self) -> dict[str, Any]:
        """Everything that is needed to train the weights again, as plain values."""
        return {
            "command": self.command(),
            "settings": {**asdict(self), "views": list(self.views)},
            "simulator": self.simulator(),
            "versions": {"r2flow": r2flow.__version__, "torch": str(torch.__version__), "numpy": np.__version__},
            "threads": torch.get_num_threads(),
        }


def class_of_label() -> np.ndarray:
    """Number in `CLASSES` of every SemanticKITTI id, (65536,), int64; IGNORED where it has none."""
    table = np.full(2**16, IGNORED)
    for name, label in LABELS.items():
        kin = "road" if name == "lane-marking" else name.removeprefix("moving-")
        if kin in CLASSES:
            table[label] = CLASSES.index(kin)
    return table


CLASS_OF_LABEL = class_of_label()


def labelled(sensor: Sensor, seed: int, scenes: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Simulated images, (B, 2, H, W), and the class of every pixel, (B, H, W)."""
    scans = [simulate(sensor, seed, scene) for scene in scenes]
    classes = np.stack([CLASS_OF_LABEL[scan.labels] for scan in scans])
    return torch.from_numpy(np.stack([scan.image for scan in scans])), torch.from_numpy(classes)


class Batches(Dataset[tuple[Tensor, Tensor]]):
    """The batch of each step: new scenes, turned at random, half of them mirrored, half with noise on their ranges."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def __len__(self) -> int:
        return self.settings.steps

    def __getitem__(self, step: int) -> tuple[Tensor, Tensor]:
        seed, b = self.settings.seed, self.settings.batch_size
        sensor = self.settings.sensor(step)
        images, classes = labelled(sensor, seed, range(step * b, (step + 1) * b))
        draw = generator(seed, "training", step)
        for image, own in zip(images, classes, strict=True):
            mirrored, turn = draw.random() < 0.5, int(draw.integers(sensor.columns))
            for q in (image, own):
                q.copy_((q.flip(-1) if mirrored else q).roll(turn, -1))
            if draw.random() < NOISY:
                disturb(image[0], draw)
        return images, classes


def disturb(r: Tensor, draw: np.random.Generator) -> None:
    """r + sigma n in place where a ray returned, n ~ N(0, 1), log sigma uniform; below 0 the ray is lost."""
    low, high = np.log(NOISE)
    sigma = float(np.exp(draw.uniform(low, high)))
    n = torch.from_numpy(draw.standard_normal(tuple(r.shape), dtype=np.float32))
    r.copy_(torch.where(r > 0, (r + sigma * n).clamp(min=0), 0))


def class_weights(settings: Settings) -> Tensor:
    """(f_c + 0.001)^(-1/2) of the share f_c of pixels of each class, divided by their mean over pixels, (K,)."""
    sensor, first = settings.sensor(0), HELD_OUT_FROM + HELD_OUT
    _, classes = labelled(sensor, settings.seed, range(first, first + COUNTED))
    share = torch.bincount(classes[classes >= 0], minlength=len(CLASSES)).double()
    share /= share.sum()
    weights = (share + 1e-3) ** -0.5
    return (weights / (weights * share).sum()).float()


def train(settings: Settings, workers: int = 0, advance: Callable[[], None] = lambda: None) -> SegmentationNetwork:
    """A trained network, in evaluation mode.

    Args:
        workers: Processes that simulate beside this one; the weights do not depend on it.
        advance: Called after each step.
    """
    with torch.random.fork_rng(devices=[]):
        seed_torch(settings.seed, "weights")
        network = SegmentationNetwork()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.momentum = MOMENTUM
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    weights = class_weights(settings)
    network.train()
    for step, (images, classes) in enumerate(DataLoader(Batches(settings), batch_size=None, num_workers=workers)):
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * learning_rate_factor(step + 1, WARMUP, settings.steps + 1)
        scans = Scans(images, settings.sensor(step))
        x = inputs(scans, reflectance=True)
        # Drawn for each scan, not for each step: batch norm then sees the mixture that its averages describe.
        hidden = generator(settings.seed, "dropout", step).random(len(scans)) < RANGE_ALONE
        x[torch.from_numpy(hidden), REFLECTANCE] = 0
        loss = F.cross_entropy(network(x), targets(scans, classes), weights, ignore_index=IGNORED)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        advance()
    return network.eval()


def judge_held_out(network: SegmentationNetwork, settings: Settings) -> dict[str, dict[str, float]]:
    """Accuracy of pixels and mean intersection over union on held-out scenes, by view and by what is shown of it."""
    judged = {}
    for view in dict.fromkeys(settings.views):
        sensor = settings.sensor(settings.views.index(view))
        images, classes = labelled(sensor, settings.seed, range(HELD_OUT_FROM, HELD_OUT_FROM + HELD_OUT))
        for reflectance in (True, False):
            shown = "range and reflectance" if reflectance else "range alone"
            judged[f"{view}, {shown}"] = judge(network, Scans(images, sensor), classes, reflectance)
    return judged


def write_weights(
    path: str | Path, network: SegmentationNetwork, settings: Settings, judged: Mapping[str, Mapping[str, float]]
) -> None:
    """Write a network with the notes on its training."""
    from safetensors.torch import save

    state = {name: value.contiguous() for name, value in network.state_dict().items()}
    notes = {**settings.notes(), "held_out": judged, "weights_sha256": state_hash(state)}
    # One entry: several would be written in changing order.
    data = save(state, metadata={"r2flow-extractor": json.dumps(notes)})
    with atomic_write(path) as file:
        file.write(data)


def targets(scans: Scans, classes: Tensor) -> Tensor:
    """Classes of the returns within the metrics' mask, IGNORED elsewhere, (B, H, W)."""
    return torch.where(scans.returned[:, 0], classes, IGNORED)


@torch.no_grad()
def judge(network: SegmentationNetwork, scans: Scans, classes: Tensor, reflectance: bool) -> dict[str, float]:
    """Accuracy of pixels, and intersection over union averaged over the classes that are there."""
    known = targets(scans, classes)
    found = torch.cat([network(x).argmax(1) for x in inputs(scans, reflectance).split(4)])
    kept, k = known >= 0, len(CLASSES)
    confusion = torch.bincount(known[kept] * k + found[kept], minlength=k * k).reshape(k, k).double()
    hit, there = confusion.diag(), confusion.sum(1) > 0
    union = confusion.sum(0) + confusion.sum(1) - hit
    return {
        "accuracy": float(hit.sum() / confusion.sum()),
        "mean_iou": float((hit / union)[there].mean()),
        "classes": int(there.sum()),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="The .safetensors to write.")
    parser.add_argument("--seed", type=int, default=0, help="Of scenes, initial weights and augmentation.")
    parser.add_argument("--steps", type=int, default=1500, help="Optimiser steps.")
    parser.add_argument("--batch-size", type=int, default=4, help="Scans of a step, each seen once.")
    parser.add_argument("--view", action="append", help="Sensor and size, as 'hdl64e 16x64'; may be repeated.")
    parser.add_argument("--workers", type=int, default=1, help="Processes that simulate.")
    given = parser.parse_args(arguments)
    prepare_folder(given.out.parent)
    settings = Settings(given.seed, given.steps, given.batch_size, tuple(given.view or VIEWS))
    with Bar("training", settings.steps, "steps") as advance:
        network = train(settings, given.workers, advance)
    judged = judge_held_out(network, settings)
    write_weights(given.out, network, settings, judged)
    rows = [(view, figures["accuracy"], figures["mean_iou"], figures["classes"]) for view, figures in judged.items()]
    print_table(rows, ("held-out simulated scans", "accuracy", "mean IoU", "classes"))
    print(f"{given.out}: {given.out.stat().st_size / 2**20:.2f} MiB")


if __name__ == "__main__":
    main()
