"""Lineage: what a run inherits from the run that it starts from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2flow.config import RULES, key_of, rule
from r2flow.data.options import SIMULATED, DataOptions, PairOptions
from r2flow.data.pairs import default_folder
from r2flow.data.reading import AUTO
from r2flow.data.resolving import resolve
from r2flow.errors import InputError
from r2flow.generators import GENERATORS
from r2flow.model.checkpoint import Checkpoint, load_checkpoint, weights_hash
from r2flow.models import name_of
from r2flow.registry import check_options, construct, options_of
from r2flow.stages import STAGES


@dataclass(frozen=True)
class Parent:
    """The run that another run starts from."""

    config: Mapping[str, Any]
    path: Path  # its checkpoint, or its folder if it has none yet
    step: int = 0
    weights: str | None = None  # `weights_hash` of the averaged weights; None if it is not trained yet
    checkpoint: Checkpoint | None = None


def find_parent(init: str | Path | None) -> Parent | None:
    """The parent that `stage.init` names, if any: a run folder must be finished, a checkpoint may be of any step."""
    if init is None:
        return None
    checkpoint = load_checkpoint(str(init))
    wanted = checkpoint.config.get("trainer", {}).get("max_steps", 0)
    if Path(str(init)).expanduser().is_dir() and name_of(checkpoint.path) is None and checkpoint.step < wanted:
        raise InputError(
            f"{init} has stopped at step {checkpoint.step} of {wanted}: finish it, or name the checkpoint to start "
            f"from, {checkpoint.path}."
        )
    return Parent(checkpoint.config, checkpoint.path, checkpoint.step, weights_hash(checkpoint), checkpoint)


def inherit(config: Mapping[str, Any], asked: Sequence[str], parent: Parent | None) -> dict[str, Any]:
    """Complete a run's config with values of its parent.

    Encoding and backbone come from the parent; also sensor, projection and convention unless the command line gives
    them (`asked`, as `backbone=hdit`). Pairs are drawn by the parent's averaged weights or by another flow
    (`data.pairs.of`), with its sensor.
    """
    config = {key: dict(value) if isinstance(value, Mapping) else value for key, value in config.items()}
    config["generator"], data, reading = generator_of(config, parent), config["data"], None
    chosen = construct("data", DataOptions, data).chosen
    if parent is None:
        stage = config["stage"]["name"]
        needs = STAGES[stage].needs_parent or STAGES[stage].needs_pairs
        if needs or data["name"] == "pairs":
            what = f"stage={stage} starts from" if needs else "data=pairs are drawn by"
            raise InputError(f"{what} a trained run: give stage.init=RUN.")
    else:
        if "published" in parent.config and parent.config["data"]["reading"]["projection"] == "unfolding":
            raise InputError(
                f"{parent.path} was trained on unfolded scans, whose rings a new run's sensor does not have; "
                "start from a flow trained on spherical images."
            )
        keys = [key_of(text) for text in asked]
        for group in [key for key in RULES if "." not in key and rule(key).inherited in ("always", "with_pairs")]:
            config[group] = _of_parent(group, config, keys, parent)
        stage = (parent.config.get("stage") or {}).get("name", "rectify")
        config["parent"] = {"path": str(parent.path), "weights": parent.weights, "step": parent.step, "stage": stage}
    if parent and data["name"] == "pairs":
        of = (data.get("pairs") or {}).get("of")
        drawer = find_parent(of) or parent
        for group in ("sensor", "encoding"):
            if drawer is not parent and drawer.config.get(group) != config[group]:
                raise InputError(
                    f"data.pairs.of={of} has another {group} than {parent.path}, which this run starts from. Leave it "
                    f"out, or start from a flow with the same {group}."
                )
        data["root"] = data["root"] or str(default_folder(drawer.path))
        data["pairs"] = pairs_of(drawer, data["pairs"] or {})
        theirs = drawer.config.get("data", {}).get("reading") or {}
        for key, value in chosen.items():
            if value != theirs.get(key) and {"data.reading", f"data.reading.{key}"} & {*keys}:
                raise InputError(f"data.reading.{key} is that of the flow that draws the pairs: leave it out.")
        data["reading"] = theirs
    elif parent and {part.get("name") for part in data.get("parts") or [data]} != {SIMULATED}:  # its rays are given
        reading = parent.config.get("data", {}).get("reading")
    return {**config, "data": resolve(data, config["sensor"].get("reflectance_scale"), reading)}


def _of_parent(group: str, config: Mapping[str, Any], asked: Sequence[str], parent: Parent) -> Any:
    """The parent's values of a group, or ours if given and they may differ; refuses values that do not fit weights."""
    theirs, ours = parent.config.get(group), config.get(group)
    if not isinstance(theirs, Mapping):
        return theirs
    if inherited(group, config) == "unless_given" and group in asked:
        return ours
    values = dict(theirs)
    for name, value in (ours or {}).items():
        key = f"{group}.{name}"
        given = any(f"{text}.".startswith(f"{key}.") for text in asked)
        if inherited(key, config) == "unless_given":
            values |= {name: value} if given else {}
        elif given or group in asked:
            differs = value != theirs[name] if name in theirs else given
            if differs and not (key == "encoding.reflectance" and value == AUTO):
                raise InputError(
                    f"{key} is {value} here, but {theirs.get(name, 'not known')} in {parent.path}, whose weights this "
                    f"run starts from. Leave it out: the {group} is the parent's."
                )
    return values


def drawn_by(config: Mapping[str, Any]) -> str | None:
    """The flow that draws a run's pairs: `data.pairs.of`, else `stage.init`."""
    return (config["data"].get("pairs") or {}).get("of") or config["stage"].get("init")


def inherited(key: str, config: Mapping[str, Any]) -> str:
    """Whether a run of this config inherits a key from its parent: no, always or unless_given."""
    mode = rule(key).inherited
    if mode != "with_pairs":
        return mode
    on_pairs = STAGES[config["stage"]["name"]].needs_pairs or config["data"]["name"] == "pairs"
    return "always" if on_pairs else "unless_given"


def generator_of(config: Mapping[str, Any], parent: Parent | None) -> dict[str, Any]:
    """The generator of a run: the config's `generator`, else the stage's, else the parent's (its `goes_on_as`); without
    a config's `generator`, with the parent's options as far as they apply."""
    if chosen := config.get("generator"):
        return {"name": chosen} if isinstance(chosen, str) else dict(chosen)
    parental = (parent and parent.config.get("generator")) or {"name": "rectified_flow"}
    chosen = STAGES[config["stage"]["name"]].generator_name or getattr(GENERATORS[parental["name"]], "goes_on_as", None)
    if chosen in (None, parental["name"]):
        return dict(parental)
    shared = options_of(GENERATORS[chosen], given=2)
    return {"name": chosen, **{key: value for key, value in parental.items() if key in shared}}


def pairs_of(parent: Parent, options: Mapping[str, Any]) -> dict[str, Any]:
    """`data.pairs` for a parent, with noise numbers that the parent was not trained on."""
    check_options("data.pairs", PairOptions, options)
    first = options.get("first")
    if first is None:
        data = parent.config.get("data", {})
        first = data["pairs"]["first"] + data["pairs"]["num"] if data.get("name") == "pairs" else 0
    return {**options, "parent": parent.weights, "first": first}
