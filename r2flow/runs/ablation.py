"""Ablations: every combination of swept config keys, trained for equal seconds with several seeds.

The seconds of a training step are measured once for each combination, which gives its number of
steps. A run of as many steps resumes bit for bit and ends with a learning rate of 0, which a run
stopped by the clock would not.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import compress, product
from pathlib import Path
from statistics import median

import lightning as L
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override

from r2flow.base.config import override
from r2flow.base.errors import InputError, naming
from r2flow.base.files import read_json, write_file
from r2flow.callbacks import ReflowPairs
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.options import SIMULATED
from r2flow.generators import as_flow
from r2flow.model.paths import find_checkpoint
from r2flow.model.tensor_files import read_checkpoint
from r2flow.runs.composing import compose
from r2flow.runs.folder import has_ended
from r2flow.runs.launch import job_folder
from r2flow.training import Run, build, fit

_PLAN = "plan.json"
_HELD_OUT = "simulated:1000"  # a seed that no run trains on
_TRIAL = 12  # steps that measure the seconds of one
_LENGTHS = ("max_steps", "val_check_interval")
_RESERVED = ("seed", "run_dir", "name", "chain", "preview")
# Of every run, unless the command line says otherwise.
_DEFAULTS = (
    "samples.num=0",
    "callbacks.pictures=null",
    "callbacks.curvature=null",
    "loggers=[csv]",
)


class Clock(L.Callback):
    """Seconds of training steps; checkpoints keep those of the whole run.

    They are those of the processor divided by the threads, which other programs do not change, or
    on other devices those of the clock.
    """

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.total = 0.0
        self.images = 0
        self._begin = 0.0

    def state_dict(self):
        return {"seconds": self.total, "images": self.images}

    def load_state_dict(self, state):
        self.total = state["seconds"]
        self.images = state["images"]

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        self._begin = _now(module.device)

    def on_train_batch_end(self, trainer, module, outputs, batch, *_):
        self.seconds.append(_now(module.device) - self._begin)
        self.total += self.seconds[-1]
        self.images += len(batch["x_1"])


def _now(device: torch.device) -> float:
    if device.type == "cpu":
        return time.process_time() / torch.get_num_threads()
    torch.accelerator.synchronize(device)
    return time.perf_counter()


@dataclass
class Ablation:
    """A sweep of config keys in a folder, with seeds 0, 1, ..., `seeds` - 1.

    Args:
        keys: Overrides `KEY=VALUE` or `KEY=VALUE,VALUE,...`, as Hydra sweeps them.
        seeds: Number of seeds.
        budget: Seconds of training of all runs together; unused if `keys` set trainer.max_steps.
        out: Folder of the plan and the runs.
    """

    keys: Sequence[str]
    seeds: int
    budget: float
    out: Path
    _data: ScanDataModule | None = field(default=None, init=False)

    @cached_property
    def _parsed(self) -> list[Override]:
        parsed = OverridesParser.create().parse_overrides(list(self.keys))
        for one in parsed:
            if one.key_or_group in _RESERVED:
                raise InputError(f"an ablation sets {one.key_or_group} itself: leave it out.")
        if not any(one.is_sweep_override() for one in parsed):
            raise InputError(
                "nothing to compare: give a key several values, as backbone=hdit_tiny,vit_tiny."
            )
        return parsed

    @cached_property
    def variants(self) -> dict[str, list[str]]:
        """Overrides of each combination, by its swept values."""
        choices = []
        for one in self._parsed:
            values = [str(one.input_line)]
            if one.is_sweep_override():
                key = one.get_key_element()
                values = [f"{key}={value}" for value in one.sweep_string_iterator()]
            choices.append(values)
        swept = [one.is_sweep_override() for one in self._parsed]
        return {
            ", ".join(text.partition("=")[2] for text in compress(own, swept)): list(own)
            for own in product(*choices)
        }

    @property
    def swept(self) -> str:
        """The swept keys."""
        return ", ".join(one.key_or_group for one in self._parsed if one.is_sweep_override())

    @property
    def seconds(self) -> float:
        """Seconds of training of each run."""
        return self.budget / (len(self.variants) * self.seeds)

    def simulated(self) -> str:
        """Held-out simulated scans for runs on simulated scans; others have to be named."""
        for own in self.variants.values():
            if compose(own)["data"]["name"] != SIMULATED:
                raise InputError("name scans that no run trains on, by --real SCANS.")
        return _HELD_OUT

    @cached_property
    def runs(self) -> dict[str, list[Path]]:
        """Run folders of each combination, one for each seed."""
        return {
            name: [
                self.out / job_folder([*self.keys, "seed=0,1"], ",".join([*own, f"seed={seed}"]))
                for seed in range(self.seeds)
            ]
            for name, own in self.variants.items()
        }

    def train(self) -> bool:
        """Train the runs that have not ended; False if `trainer.max_time` has stopped one.

        Raises:
            InputError: the folder holds another ablation, or what a run refuses.
        """
        steps = self._plan()
        count = len(self.variants) * self.seeds
        number = 0
        for seed in range(self.seeds):  # a stopped ablation has whole seeds
            for name, own in self.variants.items():
                number += 1
                run = self.runs[name][seed]
                if has_ended(run):
                    continue
                length = []
                if steps is not None:  # validated at the end alone
                    length = [f"trainer.{key}={steps[name]}" for key in _LENGTHS]
                print(f"[{number}/{count}] {name}, seed {seed}: {run}", flush=True)
                if not self._fit(name, [*length, *own], seed, run):
                    return False
        return True

    def _fit(self, name: str, own: Sequence[str], seed: int, folder: Path) -> bool:
        with naming(name):
            run = self._build(own, seed, folder)
            run.trainer.callbacks.append(Clock())  # type: ignore[attr-defined]
            return fit(run).finished

    def _build(self, own: Sequence[str], seed: int, folder: Path) -> Run:
        given = [*_DEFAULTS, *own, f"seed={seed}", override("run_dir", str(folder))]
        run = build(compose(given), given)
        if self._data is not None and self._data.described() == run.data.described():
            run.data = self._data  # with the scans that it has read
        self._data = run.data
        return run

    def _plan(self) -> Mapping[str, int] | None:
        """Steps of each combination, from the folder's plan or measured now; None: as given."""
        path = self.out / _PLAN
        given = {"keys": list(self.keys), "seeds": self.seeds, "budget": self.budget}
        if path.is_file():
            plan = read_json(path)
            if plan["given"] != given:
                raise InputError(
                    f"{self.out} holds another ablation: give its command again "
                    f"({' '.join(plan['given']['keys'])}), or another folder by --out."
                )
            return plan["steps"]
        for name, own in self.variants.items():
            with naming(name):
                run = self._build(own, 0, self.runs[name][0])
                as_flow(run.stage.generator, "an ablation", distilled=True)
        steps = None
        if not any(one.key_or_group == "trainer.max_steps" for one in self._parsed):
            steps = {name: self._steps(name) for name in self.variants}
        write_file(path, json.dumps({"given": given, "steps": steps}, indent=1))
        return steps

    def _steps(self, name: str) -> int:
        """Steps in the seconds of a run, by the median of a few."""
        trial = [f"trainer.fast_dev_run={_TRIAL}", *self.variants[name]]
        run = self._build(trial, 0, self.runs[name][0])
        clock = Clock()
        run.trainer.callbacks += [ReflowPairs(), clock]  # type: ignore[attr-defined]
        fit(run)
        seconds = median(clock.seconds[2:]) * run.trainer.accumulate_grad_batches
        print(f"{name}: {run.data.batch_size / seconds:.1f} images/s in training", flush=True)
        return max(round(self.seconds / seconds), 1)


def training_cost(run: Path) -> dict[str, float]:
    """Seconds and images a second of a run's training, by its last checkpoint."""
    clock = read_checkpoint(find_checkpoint(run))["callbacks"]["Clock"]
    return {
        "images/s in training": clock["images"] / clock["seconds"],
        "seconds of training": clock["seconds"],
    }
