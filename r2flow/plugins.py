"""Modules of somebody else that enter their classes into our registries.

    r2flow train --plugin my.module stage=my_stage
    r2flow sample --plugin ./my_stage.py runs/NAME

A package can say so itself, in the entry-point group `r2flow.plugins`: it is imported when a name is asked for that no
registry knows. A config or a checkpoint names the plug-ins that it was made with, which is information: nothing that a
file names is imported.
"""

import importlib
import importlib.util
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from r2flow.errors import InputError
from r2flow.registry import Registry, UnknownName
from r2flow.signals import Stopped

GROUP = "r2flow.plugins"

_loaded: set[str] = set()  # names and files, as sys.modules, in which a path has no name


def take_plugins(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """(the other arguments, the plug-ins) of a command line with `--plugin NAME`, anywhere and any number of times."""
    others: list[str] = []
    names: list[str] = []
    rest = iter(arguments)
    for argument in rest:
        option, equals, value = argument.partition("=")
        if option != "--plugin":
            others.append(argument)
            continue
        name = value if equals else next(rest, "")
        if not name:
            raise InputError("--plugin needs the name of a module, or a path ending in .py.")
        names.append(name)
    return others, names


def load_plugins(names: Sequence[str]) -> None:
    """Import modules, named as in an import or by a path ending in `.py`, each once."""
    for name in names:
        if _known(name) in _loaded:
            continue
        try:
            file = _import(name)
        except (KeyboardInterrupt, Stopped):
            raise
        except BaseException as error:  # whatever somebody's module raises, SystemExit too
            said = " ".join(str(error).split()) or "no more is known"
            raise InputError(f"the plug-in {name} cannot be imported: {type(error).__name__}: {said}") from None
        _loaded.update({_known(name), file})


def _known(name: str) -> str:
    """One name for one file, however its path is written."""
    return str(Path(name).expanduser().resolve()) if name.endswith(".py") else name


def _import(name: str) -> str:
    """Import a module, unless its file has been imported; its file."""
    if not name.endswith(".py"):
        here = str(Path.cwd())
        if here not in sys.path and "" not in sys.path:
            sys.path.append(here)  # as `python -m` does, but last
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.origin is not None and _known(spec.origin) in _loaded:
            return _known(spec.origin)
        file = importlib.import_module(name).__file__
        if file is None:
            raise ImportError("it is a folder without an __init__.py; to name a file, end it in .py")
        return _known(file)
    path = _known(name)
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path} is no file")
    module_name = f"r2flow_plugin_{Path(path).stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None and spec.loader is not None  # noqa: PT018
    sys.modules[module_name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[module_name]
        raise
    return path


def load_installed() -> None:
    """Import what installed packages name in the entry-point group."""
    load_plugins([entry.value.partition(":")[0] for entry in entry_points(group=GROUP)])


Registry.on_missing.append(load_installed)


@contextmanager
def made_with(config: Mapping[str, Any], what: str) -> Iterator[None]:
    """Say of an unknown name in a config from a file which plug-in it may come from.

    Args:
        what: What the config belongs to, as "the checkpoint".
    """
    try:
        yield
    except UnknownName as error:
        missing = [name for name in config.get("plugins") or () if _known(name) not in _loaded]
        if not missing:
            raise
        give = " ".join(f"--plugin {name}" for name in missing)
        known = str(error).rstrip(".")
        raise UnknownName(f"{known}; {what} was made with the plug-in {', '.join(missing)}: give {give}.") from None
