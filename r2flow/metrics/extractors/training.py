"""Training of the embedded extractor on simulated scans with their labels."""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import r2flow
from r2flow.checkpoints import read_checkpoint
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.hashing import state_hash
from r2flow.lidar.labels import LABELS
from r2flow.lidar.sensors import SENSORS, Sensor, build_sensor
from r2flow.metrics.extractors.embedded import CLASSES, REFLECTANCE, SegmentationNetwork, inputs
from r2flow.metrics.scans import Scans
from r2flow.noise import generator, seed_torch
from r2flow.simulator import simulate
from r2flow.stages.base import learning_rate_factor

IGNORED = -1  # class of pixels that are not learned from
LEARNING_RATE, WARMUP, WEIGHT_DECAY = 2e-3, 100, 1e-2
RANGE_ALONE = 1 / 3  # share of scans that are shown without reflectance
# Share of scans whose ranges are disturbed, and by how much: metres, standard deviation, log-uniform. A network that is
# shown the simulator's few millimetres alone reads them, and takes a wall with 3 cm of noise for grass.
NOISY, NOISE = 1 / 2, (0.003, 1.0)
MOMENTUM = 0.02  # of batch norm's averages, slow because sensors take turns
SAVE_EVERY = 100  # steps
COUNTED = 32  # scans that the frequencies of classes are counted on
HELD_OUT, HELD_OUT_FROM = 16, 2**32  # scenes of each sensor to judge on, and where they begin: beyond any training's

# Sensors take turns: the paper's image every third step.
VIEWS: tuple[str, ...] = (
    "hdl64e 64x1024", "hdl64e 32x256", "hdl64e_rings 64x1024", "hdl64e 64x1024", "hdl32e 32x1024", "vlp16 16x1024",
)  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """What the weights depend on.

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
        """What is typed for them; --out and --workers change nothing of the weights."""
        words = f"r2flow train-extractor --seed {self.seed} --steps {self.steps} --batch-size {self.batch_size}"
        if self.views == VIEWS:
            return words
        name, _, size = self.views[0].partition(" ")
        return f"{words} --sensor {name} --size {size}"

    def simulator(self) -> str:
        """What the simulator makes of a seed: 12 digits of the SHA-256 of one scan."""
        scan = simulate(SENSORS["hdl64e"], self.seed, 0)
        return hashlib.sha256(scan.image.tobytes() + scan.labels.tobytes()).hexdigest()[:12]

    def notes(self) -> dict[str, Any]:
        """What makes the weights again: command, settings, simulator and versions, as plain values."""
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
    """The batch of each step: scenes that were never shown before, every other one mirrored, each turned at random, and
    every other one's ranges disturbed by noise of a level of its own.
    """

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


class Training:
    """One training, which can be killed and goes on from `OUT.progress` when it is made again.

    Raises:
        InputError: the progress found is that of other settings.
    """

    def __init__(self, settings: Settings, out: str | Path) -> None:
        self.settings, self.out = settings, Path(out)
        self.progress = self.out.with_name(f"{self.out.name}.progress")
        self.notes = settings.notes()
        with torch.random.fork_rng(devices=[]):
            seed_torch(settings.seed, "weights")
            self.network = SegmentationNetwork()
        for module in self.network.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.momentum = MOMENTUM
        self.optimizer = torch.optim.AdamW(self.network.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        self.step = 0
        if self.progress.is_file():
            self._resume()
        self.weights = class_weights(settings)

    def _resume(self) -> None:
        state = read_checkpoint(self.progress)
        if state.get("notes") != self.notes:
            raise InputError(
                f"{self.progress} belongs to a training with other settings, versions, threads or simulator; delete it "
                "to begin anew, or give another --out."
            )
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step = state["step"]

    def run(self, workers: int = 0, advance: Callable[[], None] = lambda: None) -> None:
        """Train to the end.

        Args:
            workers: Processes that simulate beside this one; the weights do not depend on it.
            advance: Called after each step.
        """
        self.network.train()
        for images, classes in self._batches(workers):
            self._step(images, classes)
            self.step += 1
            if self.step % SAVE_EVERY == 0:
                self._save_progress()
            advance()
        self._save_progress()

    def _batches(self, workers: int) -> Iterator[tuple[Tensor, Tensor]]:
        steps = range(self.step, self.settings.steps)
        return iter(DataLoader(Batches(self.settings), batch_size=None, sampler=steps, num_workers=workers))

    def _step(self, images: Tensor, classes: Tensor) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = LEARNING_RATE * learning_rate_factor(self.step + 1, WARMUP, self.settings.steps + 1)
        scans = Scans(images, self.settings.sensor(self.step))
        x = inputs(scans, reflectance=True)
        # Scan by scan, not step by step: batch norm must meet the same mixture that its averages describe.
        hidden = generator(self.settings.seed, "dropout", self.step).random(len(scans)) < RANGE_ALONE
        x[torch.from_numpy(hidden), REFLECTANCE] = 0
        loss = F.cross_entropy(self.network(x), targets(scans, classes), self.weights, ignore_index=IGNORED)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()

    def _save_progress(self) -> None:
        state = {"network": self.network.state_dict(), "optimizer": self.optimizer.state_dict()}
        with atomic_write(self.progress) as file:
            torch.save({**state, "step": self.step, "notes": self.notes}, file)

    def finish(self) -> dict[str, dict[str, float]]:
        """Judge the network on held-out scenes and write it.

        Returns:
            By view and what is shown of it: accuracy of pixels and mean intersection over union.
        """
        from safetensors.torch import save

        self.network.eval()
        judged = {}
        for view in dict.fromkeys(self.settings.views):
            sensor = self.settings.sensor(list(self.settings.views).index(view))
            images, classes = labelled(sensor, self.settings.seed, range(HELD_OUT_FROM, HELD_OUT_FROM + HELD_OUT))
            for reflectance in (True, False):
                shown = "range and reflectance" if reflectance else "range alone"
                judged[f"{view}, {shown}"] = judge(self.network, Scans(images, sensor), classes, reflectance)
        state = {name: value.contiguous() for name, value in self.network.state_dict().items()}
        notes = {**self.notes, "held_out": judged, "weights_sha256": state_hash(state)}
        # one entry: the order of several would change from one writing to the next
        data = save(state, metadata={"r2flow-extractor": json.dumps(notes)})
        with atomic_write(self.out) as file:
            file.write(data)
        self.progress.unlink(missing_ok=True)
        return judged


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
