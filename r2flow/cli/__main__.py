"""python -m r2flow.cli VERB, for torchrun."""

from r2flow.cli import main

main()
