"""The rule of every config key: may it change on resume, does a child inherit it, which links does it concern.

A key's type is that of the constructor that takes it, which explains it too, and its default stands in `conf/`. A key
that is not in `RULES` follows the group that it is in; where no group around it is there either, a change makes another
run, nothing is inherited, and every link is concerned.
"""

import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal


@dataclass(frozen=True)
class Key:
    """A config key's rule.

    Attributes:
        resume: `free`: it may differ when a run resumes, for it says where and how is computed, not what.
        inherited: A run with `stage.init` has its parent's value: `always`, or `unless_given` on the command line;
            `with_pairs`, which are images of the parent, always, and else unless given.
        links: Which links of a chain take it from the chain's command line: all, those that read `scans` (the others
            inherit from them), those that learn from `pairs`, or none, for it says what the `chain` is.
    """

    resume: Literal["fixed", "free"] = "fixed"
    inherited: Literal["no", "always", "unless_given", "with_pairs"] = "no"
    links: Literal["all", "scans", "pairs", "chain"] = "all"


FREE = Key(resume="free")
OF_THE_CHAIN = Key(resume="free", links="chain")
OF_THE_MODEL = Key(inherited="always", links="scans")
OF_SCANS = Key(links="scans")

RULES: dict[str, Key] = {
    "experiment": OF_THE_CHAIN,
    "size": OF_THE_CHAIN,
    "hydra": OF_THE_CHAIN,
    "name": OF_THE_CHAIN,
    "run_dir": OF_THE_CHAIN,
    "chain": OF_THE_CHAIN,
    "preview": OF_THE_CHAIN,
    "plugins": FREE,
    "loggers": FREE,
    "samples": FREE,
    "sampler": FREE,
    "few": FREE,
    "parent.path": FREE,
    "sensor": replace(OF_THE_MODEL, inherited="with_pairs"),
    "encoding": OF_THE_MODEL,
    "encoding.levels": replace(OF_THE_MODEL, inherited="unless_given"),
    "generator": Key(inherited="unless_given", links="scans"),  # see `lineage.generator_of`
    "backbone": OF_THE_MODEL,
    "backbone.attention": replace(OF_THE_MODEL, inherited="unless_given"),  # the weights fit all the same
    "backbone.dropout": replace(OF_THE_MODEL, inherited="unless_given"),
    "backbone.inner.attention": replace(OF_THE_MODEL, inherited="unless_given"),
    "backbone.inner.dropout": replace(OF_THE_MODEL, inherited="unless_given"),
    "stage.init": FREE,
    "data": OF_SCANS,
    "data.root": replace(OF_SCANS, resume="free"),
    "data.parts.*.root": replace(OF_SCANS, resume="free"),
    "data.validation": Key(),
    "data.validation.data": OF_SCANS,
    "data.validation.data.root": replace(OF_SCANS, resume="free"),
    "data.batch_size": Key(),
    "data.workers": FREE,
    "data.memory_gib": FREE,
    "data.pairs": Key(links="pairs"),
    "data.pairs.of": Key(links="pairs", resume="free"),  # data.pairs.parent says which
    "data.scans": Key(links="pairs"),
    "data.scans.root": Key(links="pairs", resume="free"),
    "callbacks.reflow_pairs": FREE,
    "callbacks.pictures": FREE,
    "callbacks.curvature": FREE,
    "callbacks.guard": FREE,
    "callbacks.requeue": FREE,
    "callbacks.checkpoint": FREE,
    "callbacks.progress": FREE,
    "trainer.accelerator": FREE,
    "trainer.strategy": FREE,
    "trainer.devices": FREE,
    "trainer.num_nodes": FREE,
    "trainer.precision": FREE,
    "trainer.default_root_dir": FREE,
    "trainer.enable_progress_bar": FREE,
    "trainer.log_every_n_steps": FREE,
    "trainer.max_time": FREE,
    "trainer.profiler": FREE,
    "trainer.val_check_interval": FREE,
}


def rule(key: str) -> Key:
    """The rule of a key, as `data.parts.0.root`: its own, else that of the nearest group around it."""
    parts = re.sub(r"\.\d+(?=\.|$)", ".*", key).split(".")
    around = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    return next((RULES[group] for group in around if group in RULES), Key())


def groups_of(**wanted: str) -> list[str]:
    """The top-level groups whose rule has these values, as `inherited="always"`."""
    return [key for key, of in RULES.items() if "." not in key and all(getattr(of, k) == v for k, v in wanted.items())]


def key_of(override: str) -> str:
    """The key in a word of Hydra's command line, as `+data.root=x`; a group's package is left out."""
    return override.lstrip("+~").partition("=")[0].partition("@")[0].replace("/", ".")


def flatten(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """('a.b', value) for every leaf of a nested mapping; a list of groups counts them, 'a.0.b'."""
    for key, value in config.items():
        if isinstance(value, Sequence) and value and all(isinstance(one, Mapping) for one in value):
            value = dict(enumerate(value))
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def check_tree(config: Mapping[str, Any]) -> None:
    """Refuse a config that contains itself, as an anchor of YAML or a pickle can have it.

    Raises:
        ValueError: it does, or it is nested too deeply to be one.
    """
    try:
        json.dumps(config, skipkeys=True, default=str)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def learned(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A config without its free keys: what was learned, and neither where nor how it was computed."""
    found: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            inner = learned(value, f"{prefix}{key}.")
            if inner:
                found[key] = inner
        elif rule(f"{prefix}{key}").resume == "fixed":
            groups = isinstance(value, Sequence) and value and all(isinstance(one, Mapping) for one in value)
            found[key] = [learned(one, f"{prefix}{key}.{n}.") for n, one in enumerate(value)] if groups else value
    return found


def as_override(key: str, path: str | Path) -> str:
    """KEY=PATH as a shell and then Hydra's grammar read it back; to the latter a space or a = needs quotes."""
    text = str(path)
    if not re.fullmatch(r"[\w./~-]+", text):
        text = '"' + re.sub(r'(\\*)"', r'\1\1\\"', text) + '"'
    return shlex.quote(f"{key}={text}")
