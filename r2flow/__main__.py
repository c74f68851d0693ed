"""python -m r2flow VERB, for torchrun."""

from r2flow.cli import main

main()
