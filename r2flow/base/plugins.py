"""Plug-ins: external modules that register classes.

    r2flow train --plugin my.module stage=my_stage
    r2flow sample --plugin ./my_stage.py runs/NAME

Installed packages in the entry-point group `r2flow.plugins` are imported when a registry lacks a
name. Configs and checkpoints list their plug-ins for information only: r2flow never imports a
module because a file names it.
"""

import argparse
import importlib
import importlib.util
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from hashlib import sha256
from importlib.metadata import entry_points
from pathlib import Path
from traceback import walk_tb

from r2flow.base.errors import InputError, check
from r2flow.base.registry import Registry, UnknownName

GROUP = "r2flow.plugins"

# Names and files of loaded modules, and the names that were given for them.
_loaded: dict[str, str] = {}


def take_plugins(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a command line into (other arguments, names of plug-ins), for any number of `--plugin
    NAME`.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--plugin", action="append", default=[])
    try:
        parsed, others = parser.parse_known_args(arguments)
    except argparse.ArgumentError:
        parsed = argparse.Namespace(plugin=[""])
    check(all(parsed.plugin), "--plugin needs the name of a module, or a path ending in .py.")
    return others, parsed.plugin


def load_plugins(names: Sequence[str]) -> None:
    """Import modules once, by name or by a path ending in `.py`."""
    for name in names:
        if _identity(name) in _loaded:
            continue
        try:
            file = _import(name)
        except (Exception, SystemExit) as error:  # modules may raise any exception
            message = " ".join(str(error).split()) or "no message"
            where = ""
            for frame, line in walk_tb(error.__traceback__):
                if frame.f_code.co_filename == _identity(name):  # the last one is shown
                    where = f" (line {line})"
            message += where
            raise InputError(
                f"the plug-in {name} cannot be imported: {type(error).__name__}: {message}"
            ) from None
        _loaded.update({_identity(name): name, file: name})


def loaded_plugins() -> list[str]:
    """Names of the loaded modules, as they were given."""
    return list(dict.fromkeys(_loaded.values()))


def plugin_digests() -> list[str]:
    """SHA-256 of the loaded modules' files: stored results depend on a plug-in's code."""
    return [
        sha256(Path(file).read_bytes()).hexdigest()
        for file in sorted(_loaded)
        if Path(file).is_file()
    ]


def _identity(name: str) -> str:
    return str(Path(name).expanduser().resolve()) if name.endswith(".py") else name


def _import(name: str) -> str:
    """Import a module, unless its file has been imported; return its file."""
    folder = str(Path(_identity(name)).resolve().parent)  # of the file, or the working folder
    if folder not in sys.path:
        sys.path.append(folder)  # as Python does for a script and for `-m`, but last
    if not name.endswith(".py"):
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.origin is not None and _identity(spec.origin) in _loaded:
            return _identity(spec.origin)
        file = importlib.import_module(name).__file__
        if file is None:
            raise ImportError(
                "it is a folder without an __init__.py; to name a file, end it in .py"
            )
        return _identity(file)
    path = _identity(name)
    module_name = f"r2flow_plugin_{Path(path).stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None and spec.loader is not None  # noqa: PT018
    sys.modules[module_name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return path


def load_installed() -> None:
    """Import the modules of installed packages in the entry-point group."""
    load_plugins([entry.value.partition(":")[0] for entry in entry_points(group=GROUP)])


Registry.on_missing.append(load_installed)


@contextmanager
def made_with(plugins: Sequence[str], what: str) -> Iterator[None]:
    """Add the plug-ins that may define an unknown name to the error; `what` was made with them."""
    try:
        yield
    except UnknownName as error:
        missing = [name for name in plugins if _identity(name) not in _loaded]
        if not missing:
            raise
        give = " ".join(f"--plugin {name}" for name in missing)
        message = str(error).rstrip(".")
        raise UnknownName(
            f"{message}; {what} was made with the plug-in {', '.join(missing)}: give {give}."
        ) from None
