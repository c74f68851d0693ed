"""u(x, t, s): a network of two times is the network of one time that it starts from, until it
learns otherwise.
"""

import pytest
import torch
from tiny_backbones import COLUMNS, ROWS, TWO_TIMES, Plain, image, rays, tiny, untrained

from r2flow.backbones import Backbone
from r2flow.base.errors import InputError


def grown(name: str) -> tuple[torch.nn.Module, torch.nn.Module]:
    """A network of one time, and one of two times with its weights: (one, two)."""
    one, two = tiny(name), untrained(name, second_time=True).eval()
    missing, unexpected = two.load_state_dict(one.state_dict(), strict=False)
    assert {name.split(".")[0] for name in missing} == {"interval_embedding"}
    assert not unexpected
    return one, two


@pytest.mark.parametrize("name", TWO_TIMES)
@pytest.mark.parametrize("autocast", [False, True])
def test_with_the_weights_of_one_time_it_is_that_network_for_every_s(name, autocast):
    one, two = grown(name)
    x = image()
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
        for t in (torch.tensor([0.2, 0.7]), 0.3):
            expected = one(t, x)
            assert expected.any()
            assert torch.equal(two(t, x), expected)
            for s in (0.0, 0.3, 1.0):
                s = torch.tensor([s, 1 - s]) if isinstance(t, torch.Tensor) else s
                assert torch.equal(two(t, x, s), expected)


@pytest.mark.parametrize("name", TWO_TIMES)
def test_training_reaches_the_second_time(name):
    """The zero matrix learns first, then what is before it; by then s matters."""
    _, two = grown(name)
    x, t, s = image(), torch.tensor([0.2, 0.7]), torch.tensor([0.9, 0.8])
    added = list(two.interval_embedding.parameters())
    zero = [p for p in added if not p.any()]
    assert len(zero) == 1
    for reached in (zero, added):
        two.zero_grad()
        two(t, x, s).square().mean().backward()
        assert all(p.grad.isfinite().all() and p.grad.any() for p in reached)
        with torch.no_grad():
            for p in zero:
                p.sub_(p.grad / p.grad.norm())
    with torch.no_grad():
        assert (two(t, x, s) - two(t, x)).abs().max() > 1e-4
        assert torch.equal(two(t, x), two(t, x, t))


@pytest.mark.parametrize("name", TWO_TIMES)
def test_gradcheck_of_both_times(name):
    model, x = tiny(name, second_time=True).double(), image().double()
    weights = torch.randn_like(x)
    times = [torch.rand(2, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    assert torch.autograd.gradcheck(lambda t, s: (model(t, x, s) * weights).sum(), times)


@pytest.mark.parametrize("name", TWO_TIMES)
def test_nearby_second_times_are_told_apart_under_autocast(name):
    """bfloat16 would round 0.9985 to 1."""
    model, x = tiny(name, second_time=True), image(1)
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        assert not torch.equal(model(0.0, x, 1.0), model(0.0, x, 0.9985))


def test_a_backbone_that_takes_one_time_says_so_when_it_is_built():
    with pytest.raises(
        InputError, match="OneTime takes no second time: choose a backbone that does"
    ):
        type("OneTime", (Backbone,), {})(rays(), second_time=True)


@pytest.mark.parametrize(("part", "found"), [((slice(2), [0]), r"\(2, 1, "), ([0], r"\(1, 2, ")])
def test_a_backbone_that_gives_another_shape_is_named(part, found):
    class Ranges(Plain):
        def velocity(self, t, x, s=None):
            return super().velocity(t, x)[part]  # a part would broadcast

    with pytest.raises(
        InputError,
        match=rf"a Ranges must give images of \(2, 2, {ROWS}, {COLUMNS}\), found {found}",
    ):
        Ranges(rays())(0.5, image(2))
