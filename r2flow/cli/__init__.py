"""Command line: r2flow VERB."""

import sys
from collections.abc import Sequence

from r2flow.base.memory import prepare_process
from r2flow.base.signals import handling_signals_of_program


def main(*verb: str, command: Sequence[str] = ("-m", "r2flow", "train")) -> None:
    """Run a verb; Ctrl-C, SIGTERM and SIGHUP stop it with a one-line message.

    `verb` precedes the command line; Python with `command` trains a link of a chain or a job of a
    sweep.
    """
    prepare_process()
    with handling_signals_of_program():
        from r2flow.cli.verbs import run

        sys.exit(run([*verb, *sys.argv[1:]], [sys.executable, *command]))
