"""Register the verbs and run one."""

import logging
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from r2flow import __version__
from r2flow.base.errors import (
    InputError,
    PlainFormatter,
    Unbroken,
    explain_mistake,
    one_line,
    open_streams,
)
from r2flow.base.plugins import load_plugins, take_plugins
from r2flow.base.signals import Stopped, handling_signals, stop_at_once
from r2flow.cli import ablate, complete, data, draw, evaluate, files, reports, train, view  # noqa: F401 (each registers its verbs)
from r2flow.cli.app import app

# ClickException: in click for older releases of typer, in typer for newer ones.
USAGE_ERROR: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

# Errors of torch and Python that a user can act on -> what to do.
_CURES = {
    r"MPS framework doesn't support float64": "Use --device cpu.",
    r"DataLoader worker \(pid": "Is there memory for as many processes that read scans?",
    r"home directory": "Write the path in full.",
    r"allocate|out of memory|not enough memory|failed to map "
    r"segment": "Give smaller batches or images, or more memory.",
}


def run(arguments: Sequence[str], command: Sequence[str]) -> int:
    """Run a verb, with `--plugin MODULE` anywhere; the exit code is 2 for a user error, which
    prints one line.

    `command` starts the processes of chains and sweeps. Shells leave the ~ of --out=~/scans, which
    is expanded here.
    """
    open_streams()
    handler = logging.StreamHandler()
    handler.setFormatter(PlainFormatter("%(levelname)s %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    try:
        with handling_signals(stop_at_once):
            if "" in arguments:
                raise InputError("an argument is empty; is a variable of the shell not set?")
            arguments = [
                re.sub("(?<![^=])~(?=/)", lambda _: str(Path.home()), text) for text in arguments
            ]
            arguments, plugins = take_plugins(arguments)
            load_plugins(plugins)
            if "--version" in arguments and arguments[0] in ("--version", "train"):
                print(f"r2flow {__version__}")
                return 0
            code = app(arguments, prog_name="r2flow", standalone_mode=False, obj=(command, plugins))
            sys.stdout.flush()
            if Unbroken.lost:
                raise Unbroken.lost
            return code if isinstance(code, int) else 0
    except Stopped as stop:
        if str(stop):  # empty but on the first device
            print(stop, file=sys.stderr)
        return stop.code
    except (KeyboardInterrupt, typer.Abort):  # Ctrl-C outside our handler, in a library's thread
        print("stopped", file=sys.stderr)
        return 130
    except (InputError, OSError) as error:
        message = explain_mistake(error)
    except (ImportError, MemoryError, RuntimeError, TypeError) as error:
        text = str(error) or "out of memory"
        if isinstance(error, MemoryError) and str(error):  # of a library in C++: std::bad_alloc
            text = f"out of memory ({text})"
        cures = [cure for words, cure in _CURES.items() if re.search(words, text)]
        if not cures:
            raise
        message = f"{text.splitlines()[0].rstrip('.')}. {cures[0]}"
    except USAGE_ERROR as error:
        text = one_line(error.format_message()).rstrip(".") or "no verb given"
        text += _verb_of_model(text)
        message = f"{text}{'' if text.endswith('?') else '.'} See --help."
    print(f"error: {message}", file=sys.stderr)
    return 2


def _verb_of_model(text: str) -> str:
    """Advice for a model's name in the place of a verb."""
    from r2flow.model.shipped import DEFAULT, MODELS

    for name in MODELS:
        if f"command '{name}'" in text:
            verb = f"sample -c {name}" if name == DEFAULT else f"complete SCANS -c {name}"
            return f": it is a model. Did you mean 'r2flow {verb} --out FOLDER'?"
    return ""
