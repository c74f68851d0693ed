"""python -m r2flow VERB."""

from r2flow.cli import __main__  # noqa: F401
