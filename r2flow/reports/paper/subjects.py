"""The generators of a report: which row of the paper each one is (1-RF, 1-TD, R2DM, ...), and which form a chain."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from r2flow.errors import InputError
from r2flow.evaluation.sets import is_checkpoint
from r2flow.lidar.sensors import Sensor
from r2flow.model.checkpoint import load_checkpoint, weights_hash
from r2flow.reports.compare import find_runs, labels

log = logging.getLogger(__name__)

# The paper's names of other systems in its table's order, by that of the generator.
SYSTEMS = {
    "vanilla_gan": "Vanilla GAN",
    "dusty1": "DUSty v1",
    "dusty2": "DUSty v2",
    "score": "LiDARGen",
    "latent_diffusion": "LiDM",
    "diffusion": "R2DM",
}


@dataclass(frozen=True)
class PaperRun:
    """One generator.

    Attributes:
        run, label: Its folder or file, and its name on the page.
        role: "1-RF", "2-RF", "2-TD" for one that was distilled from a 2-RF, "2-TD of 1-RF" from another; the name in
            table I for another system, with ", range" where it makes no reflectance.
        family: The `weights_hash` of the 1-RF that it descends from: flows of one family are one chain.
        weights: Its own `weights_hash`.
        steps: Of a generator that is run in one number of steps only, as k of a k-TD; None for the others.
    """

    run: Path
    label: str
    role: str
    family: str
    weights: str
    config: dict[str, Any]
    steps: int | None
    sensor: Sensor

    @property
    def system(self) -> bool:
        """Whether it is none of the paper's own flows."""
        return system_of(self.config) is not None

    @property
    def seed(self) -> int | None:
        return self.config.get("seed")

    @property
    def backbone(self) -> str:
        return str(self.config["backbone"]["name"])

    @property
    def position(self) -> str:
        """What tells a token its place: "learnable" (the paper's APE), "none", ..."""
        return str(self.config["backbone"].get("position") or "none")

    @property
    def kind(self) -> str:
        """Its backbone, and for HDiT what tells a token its place; "" for another system, whose role says it."""
        if self.system:
            return ""
        if self.backbone != "hdit":
            return self.backbone
        return f"hdit {({'learnable': 'with APE', 'none': 'without APE'}).get(self.position, self.position)}"


def find_subjects(folders: Sequence[Path]) -> list[PaperRun]:
    """The runs in some folders and the checkpoint files among them, parents before their children.

    A child is known by its parent's weights, wherever the folders have moved. Autoencoders make no scans by themselves
    and are left out.

    Raises:
        InputError: no run there, runs of several sensors or encodings, or flows without a 1-RF among them.
    """
    files = [path for path in folders if path.is_file() and is_checkpoint(str(path))]
    others = [path for path in folders if path not in files]
    runs = [*(find_runs(others) if others or not files else []), *files]
    if not runs:
        raise InputError(f"no run in {', '.join(map(str, folders))}; give folders that train.py has written.")
    found: dict[str, PaperRun] = {}
    read = [_read(run, label) for run, label in zip(runs, labels(runs), strict=True)]
    rest = [one for one in read if one is not None]
    if not rest:
        raise InputError(f"{runs[0]} is an autoencoder alone and makes no scans; give the diffusion of its latents.")
    while rest:
        # A run whose parent is not among the runs is the first of a family.
        waiting = {one.weights for one in rest}
        known = [one for one in rest if one.family not in waiting] or rest
        for one in known:
            parent = found.get(one.family)
            role = _role(one, parent)
            found[one.weights] = replace(one, role=role, family=parent.family if parent else one.weights)
        rest = [one for one in rest if one not in known]
    order = [*SYSTEMS, None]  # that of table I; the paper's own flows come last

    def place(one: PaperRun) -> tuple[int, bool]:
        return order.index(one.config["generator"]["name"] if one.system else None), "+ APE" in one.role

    subjects = sorted(found.values(), key=place)
    _check_comparable(subjects)
    return subjects


def system_of(config: Mapping[str, Any]) -> str | None:
    """The paper's name of a system, None for the paper's own flows."""
    options = config.get("generator") or {}
    name = SYSTEMS.get(options.get("name", ""))
    if name == "LiDM" and (options.get("unet") or {}).get("position") == "learnable":
        name = "LiDM + APE"
    return name and (name if config["encoding"]["reflectance"] else f"{name}, range")


def _read(run: Path, label: str) -> PaperRun | None:
    """A run by its own config, its role still its stage; its family is still its parent's weights, "" without one."""
    checkpoint = load_checkpoint(run)
    config, generator = checkpoint.config, checkpoint.generator
    if (config.get("generator") or {}).get("name") == "vq_autoencoder":
        log.warning("%s is an autoencoder, which makes no scans, and is left out.", run)
        return None
    system, own = system_of(config), generator.sampler
    stage = (config.get("stage") or {}).get("name") or label  # a published file does not say which flow it is
    parent = "" if system else (config.get("parent") or {}).get("weights", "")
    single = own.fixed or generator.evaluations_of(generator.in_steps(1)) > 1
    steps = own.steps if single else None
    return PaperRun(run, label, system or stage, parent, weights_hash(checkpoint), config, steps, checkpoint.sensor)


def _role(one: PaperRun, parent: PaperRun | None) -> str:
    if one.role == "rectify":
        return "1-RF"
    if one.system or not one.config.get("parent"):
        return one.role
    # Of a parent that is not among the runs only the stage is known.
    above = parent.role if parent else {"rectify": "1-RF", "reflow": "2-RF"}.get(one.config["parent"]["stage"], "")
    number, _, kind = above.partition("-")
    if one.role == "reflow" and kind == "RF":
        return f"{int(number) + 1}-RF"
    if one.role == "distill":
        return f"{one.steps}-TD" if above == "2-RF" else f"{one.steps}-TD of {above}"
    return f"{'map' if one.role == 'flow_map' else one.role} of {above}"


def _check_comparable(subjects: Sequence[PaperRun]) -> None:
    flows = [one for one in subjects if not one.system]
    if flows and not any(one.role == "1-RF" for one in flows):
        raise InputError(f"no 1-RF among the flows: {', '.join(f'{one.label} is {one.role}' for one in flows)}.")
    for one in subjects:
        if (one.sensor.shape, one.sensor.elevations) != (subjects[0].sensor.shape, subjects[0].sensor.elevations):
            raise InputError(
                f"{one.label} and {subjects[0].label} look through different sensors or sizes. "
                "Report on them one by one."
            )
    # Other systems have ranges and encodings of their own, as in the paper.
    for one, group in product(flows, ("sensor", "encoding")):
        first = flows[0]
        if one.config[group] != first.config[group]:
            raise InputError(
                f"{one.label} and {first.label} have another {group}, and distances between such scans mean nothing. "
                "Report on them one by one."
            )
