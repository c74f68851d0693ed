"""r2flow VERB: what is done with scans and checkpoints from the command line."""

import logging
import os
import sys
from typing import Any

import typer

from r2flow import __version__
from r2flow.cli import (  # noqa: F401 (each enters its verbs)
    accuracy,
    compare,
    evaluate,
    flows,
    inversion,
    measure,
    pairs,
    paper,
    prepare,
    scans,
    sensors,
    simulate,
    train,
    unpack,
    weights,
)
from r2flow.cli.app import app
from r2flow.errors import InputError, explain_mistake
from r2flow.plugins import load_plugins, take_plugins

# Its home is click in older releases of typer and typer itself in newer ones.
USAGE_ERROR: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


def main() -> None:
    """Run a verb, with `--plugin MODULE` anywhere; what the user can mend is one line and exit code 2."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s", force=True)
    try:
        arguments, plugins = take_plugins(sys.argv[1:])
        load_plugins(plugins)
        if arguments[:1] == ["train"]:  # which passes them on to its own processes
            arguments += [f"--plugin={name}" for name in plugins]
        if arguments[:1] == ["--version"]:
            print(f"r2flow {__version__}")
            sys.exit(0)
        code = app(arguments, prog_name="r2flow", standalone_mode=False)
    except BrokenPipeError:  # r2flow ... | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except (InputError, OSError) as error:
        print(f"error: {explain_mistake(error)}", file=sys.stderr)
        sys.exit(2)
    except USAGE_ERROR as error:
        print(f"error: {error.format_message()} See --help.", file=sys.stderr)
        sys.exit(2)
    except typer.Abort:
        print("stopped", file=sys.stderr)
        sys.exit(130)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)
