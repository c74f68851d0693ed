"""Command line: r2flow VERB."""

from r2flow.memory import prepare_process
from r2flow.signals import heard_from_the_first_import


def main() -> None:
    """Run a verb; Ctrl-C, SIGTERM and SIGHUP stop it with a one-line message."""
    prepare_process()
    with heard_from_the_first_import():
        from r2flow.cli.verbs import run

        run()
