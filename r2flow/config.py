"""Rules of config keys: whether a key may change on resume, and which links of a chain it applies
to.

Constructors document and type the keys; defaults are in `conf/`. A key without an entry in `RULES`
follows its innermost group with one, else the defaults of `Key`.
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
    """Rule of a config key."""

    resume: Literal["fixed", "free"] = (
        "fixed"  #: `free`: may differ on resume, since it does not affect the result
    )
    #: Links of a chain that take the key from the chain's command line: `all`, those that read
    #: `scans` (others inherit from them), those trained on `pairs`, or none, for keys of the
    #: `chain`.
    links: Literal["all", "scans", "pairs", "chain"] = "all"


FREE = Key(resume="free")
OF_THE_CHAIN = Key(resume="free", links="chain")
OF_SCANS = Key(links="scans")
OF_PAIRS = Key(links="pairs")

RULES: dict[str, Key] = {
    **dict.fromkeys(
        ("experiment", "size", "hydra", "name", "run_dir", "chain", "preview"), OF_THE_CHAIN
    ),
    **dict.fromkeys(("plugins", "loggers", "samples", "sampler", "few"), FREE),
    **dict.fromkeys(("stage.parent.path", "stage.parent.pairs"), FREE),
    **dict.fromkeys(
        ("sensor", "encoding", "generator", "backbone", "data", "data.validation.data"), OF_SCANS
    ),
    **dict.fromkeys(
        ("data.root", "data.parts.*.root", "data.validation.data.root"),
        replace(OF_SCANS, resume="free"),
    ),
    **dict.fromkeys(("data.validation", "data.batch_size"), Key()),
    **dict.fromkeys(("data.workers", "data.memory_gib"), FREE),
    **dict.fromkeys(("data.pairs", "data.scans"), OF_PAIRS),
    # data.pairs.parent identifies the flow that draws them.
    **dict.fromkeys(("data.pairs.of", "data.scans.root"), replace(OF_PAIRS, resume="free")),
    **dict.fromkeys(
        (
            *(
                "callbacks.reflow_pairs",
                "callbacks.pictures",
                "callbacks.curvature",
                "callbacks.guard",
            ),
            *("callbacks.requeue", "callbacks.checkpoint", "callbacks.progress"),
            *(
                "trainer.accelerator",
                "trainer.strategy",
                "trainer.devices",
                "trainer.num_nodes",
                "trainer.precision",
            ),
            *(
                "trainer.default_root_dir",
                "trainer.enable_progress_bar",
                "trainer.log_every_n_steps",
            ),
            *("trainer.max_time", "trainer.profiler", "trainer.val_check_interval"),
        ),
        FREE,
    ),
}


def rule(key: str) -> Key:
    """Rule of a key, such as `data.parts.0.root`, or of its innermost group with a rule."""
    parts = re.sub(r"\.\d+(?=\.|$)", ".*", key).split(".")
    groups = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    return next((RULES[group] for group in groups if group in RULES), Key())


def key_of(override: str) -> str:
    """Key of a Hydra override such as `+data.root=x`, without a group's package."""
    return override.lstrip("+~").partition("=")[0].partition("@")[0].replace("/", ".")


def flatten(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """('a.b', value) for every leaf of a nested mapping; groups in a list are numbered, 'a.0.b'."""
    for key, value in config.items():
        if (
            isinstance(value, Sequence)
            and value
            and all(isinstance(group, Mapping) for group in value)
        ):
            value = dict(enumerate(value))
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, str]:
    """Keys whose values differ between two configs, with a text of both values."""
    before, now = dict(flatten(old)), dict(flatten(new))
    keys = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    return {
        key: f"{key}={_brief(before.get(key))} there, {_brief(now.get(key))} here" for key in keys
    }


def _brief(value: Any) -> str:
    return (
        f"a list of {len(value)}"
        if isinstance(value, list | tuple) and len(value) > 6
        else str(value)
    )


def at_most_three(texts: Sequence[str]) -> str:
    """The first of some texts, and how many more there are."""
    return "; ".join(texts[:3]) + (f" (and {len(texts) - 3} more)" if len(texts) > 3 else "")


MOST = 10**6  # values of a config


def check_tree(config: Mapping[str, Any]) -> None:
    """Raise an error for a config that contains itself or one part too often, as YAML and pickles
    can, or whose groups are not groups.
    """
    if _size(config, {}) > MOST:
        raise ValueError(f"it has more than {MOST:,} values")
    for key in ("stage", "data", "trainer"):
        if not isinstance(config.get(key) or {}, Mapping):
            raise ValueError(f"its '{key}' is not a group of keys")


def _size(value: Any, known: dict[int, int]) -> int:
    """Number of values in a tree, each part walked once; a tree that contains itself has no end."""
    if not isinstance(value, Mapping | list | tuple):
        return 1
    if id(value) not in known:
        known[id(value)] = MOST  # while it is walked
        parts = value.values() if isinstance(value, Mapping) else value
        known[id(value)] = 1 + sum(_size(part, known) for part in parts)
    return known[id(value)]


def learned(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A config without its free keys: the settings that affect the result."""
    fixed: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            if inner := learned(value, f"{prefix}{key}."):
                fixed[key] = inner
        elif rule(f"{prefix}{key}").resume == "fixed":
            groups = (
                isinstance(value, Sequence)
                and value
                and all(isinstance(group, Mapping) for group in value)
            )
            fixed[key] = (
                [learned(group, f"{prefix}{key}.{n}.") for n, group in enumerate(value)]
                if groups
                else value
            )
    return fixed


def override(key: str, value: Any) -> str:
    """An override KEY=VALUE in Hydra's grammar."""
    if isinstance(value, list | tuple):
        return f"{key}=[{','.join(override('', item)[1:] for item in value)}]"
    if value is None or isinstance(value, bool):
        return f"{key}={json.dumps(value)}"
    if isinstance(value, str) and not re.fullmatch(
        r"(?!(?i:null|true|false|inf|nan)$)[a-zA-Z][\w-]*", value, re.A
    ):
        value = (
            "'" + re.sub(r"(\\*)('|$)", lambda m: 2 * m[1] + ("\\'" if m[2] else ""), value) + "'"
        )
    return f"{key}={value}"


def as_override(key: str, path: str | Path) -> str:
    """KEY=PATH quoted for a shell and for Hydra's grammar."""
    plain = re.fullmatch(r"[a-zA-Z/][\w./-]*/[\w./-]*", str(path), re.A)
    return shlex.quote(f"{key}={path}" if plain else override(key, str(path)))
