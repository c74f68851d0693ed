"""Flows that come from flows: what a run takes over from the one that it starts from."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from r2flow.checkpoints import Checkpoint, load_checkpoint, weights_hash
from r2flow.data.options import PairOptions
from r2flow.data.pairs import default_folder
from r2flow.data.sources import AUTO
from r2flow.errors import InputError
from r2flow.registry import check_options
from r2flow.runs import flatten
from r2flow.stages import STAGES

# What a flow that starts from another's weights takes over from it.
INHERITED = ("sensor", "encoding", "backbone")
# Of these, what may differ all the same: the weights fit.
OWN = ("backbone.attention", "backbone.dropout")


def inherit(config: Mapping[str, Any], asked: Sequence[str]) -> tuple[dict[str, Any], Checkpoint | None]:
    """The config of a run that starts from `stage.init`, completed by what its parent says, and that parent.

    Sensor, encoding and backbone are the parent's; pairs are those of its averaged weights, in its folder.

    Args:
        asked: Keys that the command line gave, as `backbone` or `backbone.depths`.

    Raises:
        InputError: the command line asks for what the parent is not, the parent is not finished, or a stage that
            needs a parent has none.
    """
    config = {key: dict(value) if isinstance(value, Mapping) else value for key, value in config.items()}
    init = config["stage"].get("init")
    if init is None:
        if STAGES[config["stage"]["name"]].needs_pairs:
            raise InputError(f"stage={config['stage']['name']} starts from a trained flow: give stage.init=RUN.")
        return config, None
    parent = load_checkpoint(init)
    check_finished(Path(init), parent)
    if "published" in parent.config and parent.config["data"]["projection"] == "unfolding":
        raise InputError(
            f"{init} was trained on unfolded scans, whose rings a new run's sensor does not carry; "
            "start from a flow trained on spherical images."
        )
    for key in asked:
        _check_agrees(key, config, parent)
    for group in INHERITED:
        own = {key: value for key, value in flatten({group: config[group]}) if key in OWN and key in asked}
        config[group] = {**parent.config[group], **{key.partition(".")[2]: value for key, value in own.items()}}
    weights = weights_hash(parent)
    config["parent"] = {
        "path": str(parent.path),
        "weights": weights,
        "step": parent.step,
        "stage": parent.config.get("stage", {}).get("name", "rectify"),
    }
    data = config["data"]
    if data["name"] == "pairs":
        data["root"] = data["root"] or str(default_folder(parent.path))
        data["pairs"] = pairs_of(parent, data["pairs"] or {}, weights)
    return config, parent


def pairs_of(parent: Checkpoint, options: Mapping[str, Any], weights: str) -> dict[str, Any]:
    """`data.pairs` for a parent of this `weights_hash`, and noise that it has not been trained on itself."""
    check_options("data.pairs", PairOptions, options)
    first = options.get("first")
    if first is None:
        data = parent.config.get("data", {})
        first = data["pairs"]["first"] + data["pairs"]["num"] if data.get("name") == "pairs" else 0
    return {**options, "parent": weights, "first": first}


def check_finished(init: Path, parent: Checkpoint) -> None:
    """A run folder means its end; a checkpoint in the middle is taken when it is named.

    Raises:
        InputError: the run in a folder has not come to its end.
    """
    wanted = parent.config.get("trainer", {}).get("max_steps", 0)
    if init.expanduser().is_dir() and parent.step < wanted:
        raise InputError(
            f"{init} has stopped at step {parent.step} of {wanted}: finish it, or name the checkpoint to start from, "
            f"{parent.path}."
        )


def _check_agrees(key: str, config: Mapping[str, Any], parent: Checkpoint) -> None:
    group = key.split(".")[0]
    if group not in INHERITED:
        return
    there = dict(flatten({group: parent.config[group]}))
    for leaf, value in flatten({group: config[group]}):
        asked = leaf == key or leaf.startswith(f"{key}.")
        if leaf == "encoding.reflectance" and value == AUTO:
            continue
        unknown = leaf not in there and leaf == key
        if asked and leaf not in OWN and (unknown or there.get(leaf, value) != value):
            raise InputError(
                f"{leaf} is {value} here, but {there.get(leaf, 'not known')} in {parent.path}, whose weights this run "
                "starts from. "
                f"Leave {key} out: the {group} is the parent's."
            )
