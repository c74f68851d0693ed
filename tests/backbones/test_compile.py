"""torch.compile: one graph without breaks, and a number of graphs that stays."""

import itertools
import random

import pytest
import torch
from tiny_backbones import NAMES, TWO_TIMES, image, tiny
from torch import Tensor

MODES = list(itertools.product((True, False), (True, False)))  # gradients, autocast


def quick(names, times):
    """All of them, those but HDiT in the long run of the tests: tracing takes seconds."""
    return [
        pytest.param(name, times, marks=() if name == "hdit" else pytest.mark.slow)
        for name in names
    ]


class Counter:
    """A compiler that runs each graph as it was traced, and counts them."""

    def __init__(self) -> None:
        self.graphs = 0

    def __call__(self, graph: torch.fx.GraphModule, _inputs: list[Tensor]):
        self.graphs += 1
        return graph.forward


@pytest.mark.parametrize(("name", "times"), [*quick(NAMES, 1), *quick(TWO_TIMES, 2)])
def test_the_whole_model_is_one_graph(name, times):
    torch.compiler.reset()
    model, counter = tiny(name, second_time=times == 2), Counter()
    compiled, x = torch.compile(model, backend=counter, fullgraph=True), image()
    for _ in range(2):
        t, *s = torch.rand(times, 2)
        torch.testing.assert_close(compiled(t, x, *s), model(t, x, *s), rtol=0, atol=1e-5)
    assert counter.graphs == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_two_graphs_for_each_mode_and_then_no_more(name):
    """One for batches of two and more, one for a single image, and never a break (fullgraph)."""
    torch.compiler.reset()
    model, counter = tiny(name), Counter()
    compiled = torch.compile(model, backend=counter, dynamic=True, fullgraph=True)

    def call(batch: int, gradients: bool, autocast: bool) -> None:
        x = image(batch)
        with (
            torch.set_grad_enabled(gradients),
            torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast),
        ):
            torch.testing.assert_close(
                compiled(torch.tensor(0.3), x), model(0.3, x), rtol=0, atol=0.1
            )

    for mode in MODES:
        for batch in (7, 5, 3, 1):  # finished samples leave the batch of an adaptive solver
            call(batch, *mode)
    assert counter.graphs == 2 * len(MODES)
    draw = random.Random(0)
    for _ in range(100):
        call(draw.choice([1, 2, 3, 4, 5, 6, 7, 8]), *draw.choice(MODES))
    assert counter.graphs == 2 * len(MODES)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_inductor_gives_the_same_values_and_gradients(name):
    torch.compiler.reset()
    # float64: a fused sum rounds otherwise in float32, by 5e-4 in single gradients of the ADM
    # U-Net.
    model = tiny(name).double()
    x, t = image().double().requires_grad_(), torch.rand(2, dtype=torch.float64)
    compiled = torch.compile(model)
    results = []
    for call in (model, compiled):
        output = call(t, x)
        results.append(
            [output, *torch.autograd.grad(output.square().sum(), [x, *model.parameters()])]
        )
    for expected, found in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
