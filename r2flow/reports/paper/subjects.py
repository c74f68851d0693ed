"""The runs of a report: which flow of the paper each one is (1-RF, 2-RF, 1-TD, ...), and which form a chain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from r2flow.checkpoints import load_checkpoint, weights_hash
from r2flow.errors import InputError
from r2flow.reports.compare import find_runs, labels


@dataclass(frozen=True)
class PaperRun:
    """One run.

    Attributes:
        run, label: Its folder, and its name on the page.
        role: "1-RF", "2-RF", "2-TD" for one that was distilled from a 2-RF, "2-TD of 1-RF" from another.
        family: The `weights_hash` of the 1-RF that it descends from: flows of one family are one chain.
        weights: Its own `weights_hash`.
        steps: k of a k-TD; None for the others.
    """

    run: Path
    label: str
    role: str
    family: str
    weights: str
    config: dict[str, Any]
    steps: int | None

    @property
    def seed(self) -> int:
        return int(self.config["seed"])

    @property
    def backbone(self) -> str:
        return str(self.config["backbone"]["name"])

    @property
    def position(self) -> str:
        """What tells a token its place: "learnable" (the paper's APE), "none", ..."""
        return str(self.config["backbone"].get("position") or "none")

    @property
    def kind(self) -> str:
        """Its backbone, and for HDiT what tells a token its place."""
        if self.backbone != "hdit":
            return self.backbone
        return f"hdit {({'learnable': 'with APE', 'none': 'without APE'}).get(self.position, self.position)}"


def find_subjects(folders: Sequence[Path]) -> list[PaperRun]:
    """The runs in some folders, parents before their children.

    A child is known by its parent's weights, wherever the folders have moved.

    Raises:
        InputError: no run there, runs of several sensors or encodings, or no 1-RF among them.
    """
    runs = find_runs(folders)
    if not runs:
        raise InputError(f"no run in {', '.join(map(str, folders))}; give folders that train.py has written.")
    found: dict[str, PaperRun] = {}
    rest = [_read(run, label) for run, label in zip(runs, labels(runs), strict=True)]
    while rest:
        # A run whose parent is not among the runs is the first of a family.
        waiting = {one.weights for one in rest}
        known = [one for one in rest if one.family not in waiting] or rest
        for one in known:
            parent = found.get(one.family)
            role = _role(one, parent)
            found[one.weights] = replace(one, role=role, family=parent.family if parent else one.weights)
        rest = [one for one in rest if one not in known]
    subjects = list(found.values())
    _check_comparable(subjects)
    return subjects


def _read(run: Path, label: str) -> PaperRun:
    """A run by its own config; its family is still its parent's weights, "" without a parent."""
    checkpoint = load_checkpoint(run)
    config, own = checkpoint.config, checkpoint.generator.sampler
    parent = (config.get("parent") or {}).get("weights", "")
    steps = own.steps if own.fixed else None
    return PaperRun(run, label, config["stage"]["name"], parent, weights_hash(checkpoint), config, steps)


def _role(one: PaperRun, parent: PaperRun | None) -> str:
    if one.role == "rectify":
        return "1-RF"
    # Of a parent that is not among the runs only the stage is known.
    above = parent.role if parent else {"rectify": "1-RF", "reflow": "2-RF"}.get(one.config["parent"]["stage"], "")
    number, _, kind = above.partition("-")
    if one.role == "reflow" and kind == "RF":
        return f"{int(number) + 1}-RF"
    if one.role == "distill":
        return f"{one.steps}-TD" if above == "2-RF" else f"{one.steps}-TD of {above}"
    return f"{'map' if one.role == 'flow_map' else one.role} of {above}"


def _check_comparable(subjects: Sequence[PaperRun]) -> None:
    if not any(one.role == "1-RF" for one in subjects):
        raise InputError(f"no 1-RF among the runs: {', '.join(f'{one.label} is {one.role}' for one in subjects)}.")
    first = subjects[0]
    for one, group in product(subjects, ("sensor", "encoding")):
        if one.config[group] != first.config[group]:
            raise InputError(
                f"{one.label} and {first.label} have another {group}, and distances between such scans mean nothing. "
                "Report on them one by one."
            )
