"""r2flow VERB: what is done with scans and checkpoints from the command line."""

from r2flow.memory import prepare_process
from r2flow.signals import heard_from_the_first_import


def main() -> None:
    """Run a verb; Ctrl-C and SIGTERM end it in one line."""
    prepare_process()
    with heard_from_the_first_import():
        from r2flow.cli.verbs import run

        run()
