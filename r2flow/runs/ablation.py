"""Ablations: every combination of swept config keys, trained for equal seconds with several seeds.

The seconds of a training step are measured once for each combination, which gives its number of
steps; finished runs give theirs. A run of as many steps resumes bit for bit and ends with a
learning rate of 0, which a run stopped by the clock would not. A combination that is a chain, as
experiment=r2flow, shares its seconds between its links, in proportion to their trainer.max_steps;
its pairs are part of them.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import torch
from filelock import FileLock
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override

from r2flow.base.config import override
from r2flow.base.errors import InputError, naming
from r2flow.base.files import read_json, write_file
from r2flow.callbacks import ReflowPairs
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.options import PAIRS, SIMULATED
from r2flow.model.config import RunConfig
from r2flow.model.paths import find_checkpoint
from r2flow.model.tensor_files import read_checkpoint
from r2flow.runs.chain import Link, check_links, links_of
from r2flow.runs.composing import compose
from r2flow.runs.folder import has_ended
from r2flow.runs.launch import job_folder
from r2flow.training import Run, build, fit

_PLAN = "plan.json"
_HELD_OUT = "simulated:1000"  # a seed that no run trains on
_TRIAL = 12  # steps that measure the seconds of one
_PAIRS = 64  # pairs that measure the seconds of one
_LENGTHS = ("max_steps", "val_check_interval")
_RESERVED = ("seed", "run_dir", "name", "chain", "preview")
# Of every run, unless the command line says otherwise.
_DEFAULTS = (
    "samples.num=0",
    "callbacks.pictures=null",
    "callbacks.curvature=null",
    "loggers=[csv]",
)


class Clock(ReflowPairs):
    """Seconds of training steps and of drawing pairs; checkpoints keep those of the whole run.

    They are those of the processor divided by the threads, which other programs do not change, or
    on other devices those of the clock.
    """

    def __init__(self) -> None:
        self.seconds: list[float] = []  # of the steps of this process
        self.drawing = 0.0  # of the pairs drawn by this process
        self.total = 0.0
        self.images = 0
        self._begin = 0.0

    def state_dict(self):
        return {"seconds": self.total, "images": self.images}

    def load_state_dict(self, state):
        self.total = state["seconds"]
        self.images = state["images"]

    def setup(self, trainer, pl_module, stage):
        device = trainer.strategy.root_device
        begin = _now(device)
        super().setup(trainer, pl_module, stage)
        self.drawing += _now(device) - begin
        self.total = self.drawing

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        self._begin = _now(module.device)

    def on_train_batch_end(self, trainer, module, outputs, batch, *_):
        self.seconds.append(_now(module.device) - self._begin)
        self.total += self.seconds[-1]
        self.images += len(batch["x_1"])


class Cost(NamedTuple):
    """Cost of a training."""

    seconds: float
    images: int
    steps: int


def _has(config: Any, names: Sequence[str]) -> bool:
    """Whether a config has a key; groups without a value have any."""
    if not names or config is None:
        return True
    name, *others = names
    return isinstance(config, Mapping) and name in config and _has(config[name], others)


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
        steps: Steps of the links of combinations, which are then not measured.
    """

    keys: Sequence[str]
    seeds: int
    budget: float
    out: Path
    steps: Mapping[str, Sequence[int]] = field(default_factory=dict)
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
        """Overrides of each combination, by its swept values. A swept key that only some choices of
        a group have, as backbone.patch, is left out for the others.
        """
        choices = []
        for one in self._parsed:
            values = [str(one.input_line)]
            if one.is_sweep_override():
                key = one.get_key_element()
                values = [f"{key}={value}" for value in one.sweep_string_iterator()]
            choices.append(values)
        combinations = [*product(*choices)]
        config_of = cache(lambda *texts: compose(texts))
        lacking = {overrides: self._lacking(overrides, config_of) for overrides in combinations}
        of_none = set.intersection(*map(set, lacking.values()))  # misspelled: Hydra refuses them
        found: dict[str, list[str]] = {}
        for overrides in combinations:
            left_out = {*lacking[overrides]} - of_none
            pairs = zip(self._parsed, overrides, strict=True)
            kept = [(one, text) for one, text in pairs if one.key_or_group not in left_out]
            values = [text.partition("=")[2] for one, text in kept if one.is_sweep_override()]
            found[", ".join(values)] = [text for _, text in kept]
        return found

    def _lacking(
        self, overrides: Sequence[str], config_of: Callable[..., Mapping[str, Any]]
    ) -> list[str]:
        """The swept keys that the config of a combination's choices does not have."""
        pairs = [*zip(self._parsed, overrides, strict=True)]
        keys = [one.key_or_group for one in self._parsed if one.is_sweep_override()]
        keys = [key for key in keys if "." in key]
        if not keys:
            return []
        config = config_of(*(text for one, text in pairs if "." not in one.key_or_group))
        return [key for key in keys if not _has(config, key.split("."))]

    @property
    def swept(self) -> str:
        """The swept keys."""
        return ", ".join(one.key_or_group for one in self._parsed if one.is_sweep_override())

    @property
    def of_systems(self) -> bool:
        """Whether it compares experiments, each with its own samplers."""
        return "experiment" in self.swept.split(", ")

    @property
    def settings(self) -> str:
        """The other keys."""
        fixed = [str(one.input_line) for one in self._parsed if not one.is_sweep_override()]
        return " ".join([self.swept, *fixed])

    @property
    def seconds(self) -> float:
        """Seconds of training of each run, with the digits of the table."""
        return float(f"{self.budget / (len(self.variants) * self.seeds):.6g}")

    def simulated(self) -> str:
        """Held-out simulated scans for runs on simulated scans; others have to be named."""
        for overrides in self.variants.values():
            if compose(overrides)["data"]["name"] != SIMULATED:
                raise InputError("name scans that no run trains on, by --real SCANS.")
        return _HELD_OUT

    @cached_property
    def runs(self) -> dict[tuple[int, str], list[Link]]:
        """The links of each seed and combination: one, or those of a chain. An ablation that is
        stopped has whole seeds.
        """
        return {
            (n, name): self._links(n, name) for n in range(self.seeds) for name in self.variants
        }

    def _links(self, seed: int, name: str) -> list[Link]:
        links = self._changed(seed, name)
        if links[0].name:
            with naming(name):
                check_links(links)
        return links

    def _changed(self, seed: int, name: str, link: str = "", *keys: str) -> list[Link]:
        """The links of a run, one of them with further keys."""
        overrides = [*self.variants[name], f"seed={seed}"]
        folder = self.out / f"{self.seconds:g}s"
        folder /= job_folder([*self.keys, "seed=0,1"], ",".join(overrides))
        composed = [*_DEFAULTS, *overrides]
        with naming(name):
            chain = compose(composed)["chain"]
            if chain is not None:
                return links_of(chain, folder, [*composed, *(f"+chain.{link}.{k}" for k in keys)])
            composed += [*keys, override("run_dir", str(folder))]
            return [Link("", RunConfig.of(compose(composed)), tuple(composed))]

    def check(self) -> None:
        """Refuse what a run of the first seed would refuse, before any is trained."""
        for name in self.variants:
            with naming(name):
                first = self.runs[0, name][0]
                if not first.name:
                    self._build(first)

    def first(self) -> Run:
        """The first run, untrained, with its training scans in memory."""
        run = self._build(next(iter(self.runs.values()))[0])
        run.data.read()
        return run

    def train(self, seed: int, name: str) -> bool:
        """Train a run, or the links of its chain; False if `trainer.max_time` has stopped it.

        Raises:
            InputError: what the run refuses.
        """
        links = self.runs[seed, name]
        total = sum(link.config.trainer.max_steps for link in links)
        for number, link in enumerate(links):
            if has_ended(link.config.run_dir):
                continue
            with naming(f"{name} {link.name}".strip()):
                if not any(one.key_or_group == "trainer.max_steps" for one in self._parsed):
                    share = link.config.trainer.max_steps / total
                    steps = self._steps(seed, name, number, self.seconds * share)
                    lengths = [f"trainer.{key}={steps}" for key in _LENGTHS]  # validated at the end
                    link = self._changed(seed, name, link.name, *lengths)[number]
                run = self._build(link)
                run.trainer.callbacks.insert(0, Clock())  # type: ignore[attr-defined]
                if not fit(run).finished:
                    return False
        return True

    def _build(self, link: Link) -> Run:
        run = build(link.config, link.asked)
        if self._data is not None and self._data.described() == run.data.described():
            run.data = self._data  # with the scans that it has read
        self._data = run.data
        return run

    def _steps(self, seed: int, name: str, number: int, seconds: float) -> int:
        """Steps of a link in as many seconds; as measured before by the plan."""
        if number < len(self.steps.get(name, ())):
            return self.steps[name][number]
        path = self.out / f"{self.seconds:g}s" / _PLAN
        path.parent.mkdir(parents=True, exist_ok=True)
        place = ", ".join([name, *self.runs[seed, name][number].name.split()])
        with FileLock(path.with_suffix(".lock")):  # other workers wait for the measurement
            plan = read_json(path) if path.is_file() else {}
            if place not in plan:
                plan[place] = self._measured_steps(seed, name, number, seconds)
                write_file(path, json.dumps(plan, indent=1))
        return plan[place]

    def _measured_steps(self, seed: int, name: str, number: int, seconds: float) -> int:
        """Steps of a link in as many seconds, by a few trial steps and, in a chain, pairs."""
        link = self.runs[seed, name][number]
        trial = [f"trainer.fast_dev_run={_TRIAL}"]
        paired = link.parent is not None and link.config.data.name == PAIRS
        if paired:
            trial += [f"data.pairs.num={_PAIRS}", f"data.pairs.batch_size={_PAIRS}"]
            # links that share pairs share no trial's
            trial.append(override("data.root", f"{link.config.run_dir}-trial"))
        run = self._build(self._changed(seed, name, link.name, *trial)[number])
        clock = Clock()
        run.trainer.callbacks.append(clock)  # type: ignore[attr-defined]
        fit(run)
        step = median(clock.seconds[2:]) * run.trainer.accumulate_grad_batches
        print(f"{name} {link.name}: {run.data.batch_size / step:.1f} images/s", flush=True)
        steps = max(round(seconds / step), 1)
        if paired:
            longer = self._changed(seed, name, link.name, f"trainer.max_steps={steps}")[number]
            drawing = longer.config.data.pairs.num * clock.drawing / _PAIRS
            steps = max(round(steps * seconds / (steps * step + drawing)), 1)
        return steps


def training_cost(link: Link) -> Cost:
    """Cost of a finished link's training, by its last checkpoint."""
    clock = read_checkpoint(find_checkpoint(link.config.run_dir))["callbacks"]["Clock"]
    steps = clock["images"] // link.config.data.batch_size
    return Cost(clock["seconds"], clock["images"], steps)
