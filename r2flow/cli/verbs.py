"""Register the verbs and run one."""

import logging
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from r2flow import __version__
from r2flow.cli import data, draw, evaluate, files, reports, train, view  # noqa: F401 (each registers its verbs)
from r2flow.cli.app import app
from r2flow.errors import InputError, PlainFormatter, Unbroken, check, explain_mistake, one_line, open_streams
from r2flow.plugins import load_plugins, take_plugins
from r2flow.signals import Stopped, listening, stop_at_once

# ClickException: in click for older releases of typer, in typer for newer ones.
USAGE_ERROR: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

GROUPS = {  # panels of --help and their verbs, in order
    "Make": ("train", "pairs"),
    "Draw": ("sample", "complete", "interpolate"),
    "Look": ("view", "show"),
    "Measure": ("evaluate", "compare"),
    "Data": ("simulate", "prepare", "sensor"),
    "Files": ("export", "info", "weights"),
}
for verb in app.registered_commands:
    assert verb.callback is not None
    verb.name = verb.callback.__name__
    verb.rich_help_panel = next((group for group, names in GROUPS.items() if verb.name in names), "Data")
app.registered_groups[0].rich_help_panel = "Measure"
app.registered_commands.sort(key=lambda verb: list(GROUPS).index(str(verb.rich_help_panel)))

FULL = ("can't allocate memory", "not enough memory", "out of memory", "failed to map segment")  # errors of torch


def run(arguments: Sequence[str], command: Sequence[str]) -> int:
    """Run a verb, with `--plugin MODULE` anywhere; the exit code is 2 for a user error, which prints one line.

    `command` starts the processes of chains and sweeps. Shells leave the ~ of --out=~/scans, which is expanded here.
    """
    open_streams()
    handler = logging.StreamHandler()
    handler.setFormatter(PlainFormatter("%(levelname)s %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    try:
        with listening(stop_at_once):
            check("" not in arguments, "an argument is empty; is a variable of the shell not set?")
            arguments = [re.sub("(?<![^=])~(?=/)", lambda _: str(Path.home()), one) for one in arguments]
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
        if "home directory" in str(error):
            message = "~ stands for nothing here: write the path in full, or set HOME; for the cache, XDG_CACHE_HOME."
        elif isinstance(error, MemoryError) or any(words in str(error) for words in FULL):
            size = re.search(r"allocate ([\d.]+ \w+)", str(error))
            more = f" for {size[1]} more" if size else ""
            message = f"the memory has no room{more}; give smaller batches or images, or more memory."
        elif "MPS framework doesn't support float64" in str(error):
            message = "Apple's GPU has no float64, which this needs: use --device cpu."
        elif "DataLoader worker (pid" in str(error):
            message = f"{one_line(str(error)).rstrip('. ')}; is there memory for as many processes that read scans?"
        else:
            raise
    except USAGE_ERROR as error:
        text = one_line(error.format_message()).rstrip(".") or "no verb given"
        message = f"{text}{'.' * (not text.endswith('?'))} See --help."
    print(f"error: {message}", file=sys.stderr)
    return 2
