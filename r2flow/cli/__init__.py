"""r2flow VERB: what is done with scans and checkpoints from the command line."""

from r2flow.signals import end_at_once, listening


def main() -> None:
    """Run a verb; Ctrl-C and SIGTERM end it in one line from the first moment on."""
    with listening(end_at_once):
        from r2flow.cli.verbs import run

        run()
