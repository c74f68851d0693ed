"""python -m r2flow.cli VERB, as torchrun starts it."""

from r2flow.cli import main

main()
