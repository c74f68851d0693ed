"""Rules of config keys: whether a key may change on resume, and which links of a chain it applies
to.

Constructors document and type the keys; defaults are in `conf/`. A rule of a group is that of its
keys, too.
"""

import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from r2flow.base.registry import Config, Options

# May differ on resume, since they do not affect the result. data.pairs.parent identifies the flow
# of data.pairs.of.
FREE = {
    "experiment",
    "size",
    "hydra",
    "name",
    "run_dir",
    "chain",
    "preview",
    "plugins",
    "loggers",
    "samples",
    "sampler",
    "few",
    "stage.parent.path",
    "stage.parent.pairs",
    "data.root",
    "data.parts.*.root",
    "data.validation.data.root",
    "data.workers",
    "data.memory_gib",
    "data.pairs.of",
    "data.scans.root",
    "callbacks.reflow_pairs",
    "callbacks.pictures",
    "callbacks.curvature",
    "callbacks.guard",
    "callbacks.requeue",
    "callbacks.checkpoint",
    "callbacks.progress",
    "trainer.accelerator",
    "trainer.strategy",
    "trainer.devices",
    "trainer.num_nodes",
    "trainer.precision",
    "trainer.default_root_dir",
    "trainer.enable_progress_bar",
    "trainer.log_every_n_steps",
    "trainer.max_time",
    "trainer.profiler",
    "trainer.val_check_interval",
}

# Links of a chain that take a key from the chain's command line: none, those that read scans
# (others inherit from them), those trained on pairs; of other keys all links.
LINKS = {
    **dict.fromkeys(("experiment", "size", "hydra", "name", "run_dir", "chain", "preview"), "none"),
    **dict.fromkeys(("sensor", "encoding", "generator", "backbone", "data"), "scans"),
    **dict.fromkeys(
        ("data.validation", "data.batch_size", "data.workers", "data.memory_gib"), "all"
    ),
    "data.validation.data": "scans",
    "data.pairs": "pairs",
    "data.scans": "pairs",
}


def _groups(key: str) -> list[str]:
    """A key such as `data.parts.0.root` with stars for numbers, and its groups, innermost first."""
    parts = re.sub(r"\.\d+(?=\.|$)", ".*", key).split(".")
    return [".".join(parts[:n]) for n in range(len(parts), 0, -1)]


def is_free(key: str) -> bool:
    """Whether a key may differ on resume."""
    return not FREE.isdisjoint(_groups(key))


def links_of_key(key: str) -> str:
    """The links of a chain that take a key from the command line, as in `LINKS`."""
    return next((LINKS[group] for group in _groups(key) if group in LINKS), "all")


def key_of(override: str) -> str:
    """Key of a Hydra override such as `+data.root=x`, without a group's package."""
    return override.lstrip("+~").partition("=")[0].partition("@")[0].replace("/", ".")


def flatten(config: Options, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """('a.b', value) for every leaf of a nested mapping; groups in a list are numbered, 'a.0.b'."""
    for key, value in config.items():
        if _lists_groups(value):
            value = dict(enumerate(value))
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _lists_groups(value: Any) -> bool:
    listed = isinstance(value, list | tuple) and len(value) > 0
    return listed and all(isinstance(group, Mapping) for group in value)


def differences(old: Options, new: Options) -> dict[str, str]:
    """Keys whose values differ between two configs, with a text of both values."""
    before = dict(flatten(old))
    now = dict(flatten(new))
    keys = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    return {
        key: f"{key}={_brief(before.get(key))} there, {_brief(now.get(key))} here" for key in keys
    }


def _brief(value: Any) -> str:
    long = isinstance(value, list | tuple) and len(value) > 6
    return f"a list of {len(value)}" if long else str(value)


def at_most_three(texts: Sequence[str]) -> str:
    """The first of some texts, and how many more there are."""
    return "; ".join(texts[:3]) + (f" (and {len(texts) - 3} more)" if len(texts) > 3 else "")


_MOST = 10**6  # values of a config


def check_tree(config: Options) -> None:
    """Raise an error for a config that contains itself or one part too often, as YAML and pickles
    can, or whose groups are not groups.
    """
    if _size(config, {}) > _MOST:
        raise ValueError(f"it has more than {_MOST:,} values")
    for key in ("stage", "data", "trainer"):
        if not isinstance(config.get(key) or {}, Mapping):
            raise ValueError(f"its '{key}' is not a group of keys")


def _size(value: Any, known: dict[int, int]) -> int:
    """Number of values in a tree, each part walked once; a tree that contains itself has no end."""
    if not isinstance(value, Mapping | list | tuple):
        return 1
    if id(value) not in known:
        known[id(value)] = _MOST  # while it is walked
        parts = value.values() if isinstance(value, Mapping) else value
        known[id(value)] = 1 + sum(_size(part, known) for part in parts)
    return known[id(value)]


def learned(config: Options, prefix: str = "") -> Config:
    """A config without its free keys: the settings that affect the result."""
    fixed: Config = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            if inner := learned(value, f"{prefix}{key}."):
                fixed[key] = inner
        elif not is_free(f"{prefix}{key}"):
            fixed[key] = value
            if _lists_groups(value):
                fixed[key] = [learned(group, f"{prefix}{key}.*.") for group in value]
    return fixed


def override(key: str, value: Any) -> str:
    """An override KEY=VALUE in Hydra's grammar."""
    if isinstance(value, list | tuple):
        return f"{key}=[{','.join(override('', item)[1:] for item in value)}]"
    if value is None or isinstance(value, bool):
        return f"{key}={json.dumps(value)}"
    if isinstance(value, str) and not re.fullmatch(
        r"(?!(?i:null|true|false|inf|nan)$)[a-zA-Z/][\w./-]*", value, re.A
    ):
        value = (
            "'" + re.sub(r"(\\*)('|$)", lambda m: 2 * m[1] + ("\\'" if m[2] else ""), value) + "'"
        )
    return f"{key}={value}"


def as_override(key: str, path: str | Path) -> str:
    """KEY=PATH quoted for a shell and for Hydra's grammar."""
    return shlex.quote(override(key, str(path)))
