"""Configs as trees of keys: the rules in the annotations of their dataclasses, comparison, Hydra's
overrides.
"""

import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_type_hints

from r2flow.base.registry import Options

T = TypeVar("T")


@dataclass(frozen=True)
class Rule:
    """Metadata of a config's field, which holds for the keys of its group, too."""

    free: bool = False  # may differ on resumption, since it does not affect the result
    found: bool = False  # filled in by the run, from its scans or its parent
    # Links of a chain that take it from the chain's command line: none, those that read scans
    # (others inherit from them), those trained on pairs; None: as of the group, else all.
    links: Literal["all", "none", "scans", "pairs"] | None = None


Free = Annotated[T, Rule(free=True)]
Found = Annotated[T, Rule(found=True)]


@cache
def rules_in(kind: Any) -> Mapping[str, Sequence[Rule]]:
    """The rules of the keys of a dataclass of options: `data.parts.root` for the root of each part.

    A mapping annotated with a dataclass has the keys of that.
    """
    table: dict[str, Sequence[Rule]] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        members = list(_members(hint))
        table[name] = [one for one in members if isinstance(one, Rule)]
        for group in filter(is_dataclass, members):
            if isinstance(group, type):
                table |= {f"{name}.{key}": rules for key, rules in rules_in(group).items()}
    return table


def _members(hint: Any) -> Iterator[Any]:
    """The classes that an annotation is made of, and its metadata."""
    yield from getattr(hint, "__metadata__", ())
    inner = [hint.__origin__] if hasattr(hint, "__metadata__") else get_args(hint)
    for one in inner:
        yield from _members(one)
    if not inner:
        yield hint


def rules_of(kind: Any, key: str) -> list[Rule]:
    """The rules of a key such as `data.parts.0.root`: its own, then those of its groups."""
    parts = [part for part in key.split(".") if not part.isdecimal()]
    groups = [".".join(parts[:n]) for n in range(len(parts), 0, -1)]
    return [rule for group in groups for rule in rules_in(kind).get(group, ())]


def key_of(override: str) -> str:
    """Key of a Hydra override such as `+data.root=x`, without a group's package."""
    return override.lstrip("+~").partition("=")[0].partition("@")[0].replace("/", ".")


def flatten(config: Options, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """('a.b', value) for every leaf of a nested mapping; groups in a list are numbered, 'a.0.b'."""
    for key, value in config.items():
        if is_groups(value):
            value = dict(enumerate(value))
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def is_groups(value: Any) -> bool:
    """Whether a value is a list of groups."""
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
    text = override(key, str(path))
    plain = "'" in text and not re.search(r'["$`\\!]', text)  # within double quotes
    return f'"{text}"' if plain else shlex.quote(text)
