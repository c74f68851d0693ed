"""Generation of reflow pairs with progress output."""

import os

import torch

from r2flow.data.pairs import Made, PairStore, make_pairs
from r2flow.model.checkpoint import Checkpoint
from r2flow.progress import Bar


def make_and_tell(store: PairStore, checkpoint: Checkpoint, device: torch.device | str, wait: bool = True) -> Made:
    """`make_pairs` with a progress bar, or lines for several processes."""
    generator = checkpoint.generator.to(device)
    with Bar("drawing", store.missing_pairs(), "pairs", lines="WORLD_SIZE" in os.environ) as bar:
        made = make_pairs(store, generator, lambda made: bar.set(made.pairs), wait)
    if made.pairs:
        unusable = f", {made.unusable} did not converge and are left out" if made.unusable else ""
        rate, cost = made.pairs / made.seconds, made.evaluations / made.pairs
        drawn = f"{made.pairs} pairs drawn in whole batches"
        print(f"{drawn}, {rate:.2f} pairs/s, {cost:.1f} evaluations a pair{unusable}", flush=True)
    return made
