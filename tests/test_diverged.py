"""A network whose numbers have no end: every generator says which of its scans are none."""

import math
from typing import Any

import pytest
from torch import nn

import r2flow
from r2flow.evaluation.sets import sampled_set
from r2flow.generators import Generator, Sampler, build_generator
from r2flow.noise import Draws
from r2flow.samplers import build_sampler
from r2flow.training import compose

SIZE = ["sensor.rows=16", "sensor.columns=32", "encoding.reflectance=true"]
TINY = ["backbone=hdit_tiny", "backbone.base_channels=16", "backbone.num_heads=[1,2,4]"]


def endless(network: nn.Module, count: int) -> None:
    """Let the first `count` answers of each batch be infinite."""

    def at_the_end(_: nn.Module, __: Any, found: Any) -> Any:
        if isinstance(found, dict):
            return {name: at_the_end(_, __, value) for name, value in found.items()}
        found = found.clone()
        found[:count] = math.inf
        return found

    network.register_forward_hook(at_the_end)


@pytest.mark.parametrize(
    ("words", "sampler"),
    [
        (TINY, build_sampler("euler", steps=2)),
        (TINY, build_sampler("sde", steps=2)),
        ([*TINY, "+generator.name=flow_map"], build_sampler("jump", steps=1)),
        ([*TINY, "+generator.name=flow_map"], build_sampler("jump", steps=3)),
        ([*TINY, "+generator.name=flow_map"], build_sampler("renoise", steps=2)),
        (["experiment=r2dm", "size=small"], build_sampler("ddpm", steps=2)),
        (["experiment=r2dm", "size=small"], build_sampler("ddim", eta=0, steps=1)),
        (
            ["experiment=lidargen", "size=small", "generator.levels=2", "generator.width=4"],
            build_sampler("langevin", steps=1),
        ),
        (["experiment=vanilla_gan", "size=small", "generator.base_channels=4"], build_sampler("direct")),
        (["experiment=dusty2", "size=small", "generator.base_channels=4"], build_sampler("direct")),
    ],
)
def test_a_scan_that_leaves_the_numbers_is_flagged_whatever_is_clamped(words: list[str], sampler: Sampler):
    generator: Generator = build_generator(compose([*words, *SIZE])).eval()
    endless(getattr(generator, "backbone", None) or generator.network, 1)
    draws = Draws(0, range(3))
    made = generator(draws.start(generator.noise_shape), sampler=sampler, draws=draws)
    assert made.converged.tolist() == [False, True, True]


def test_a_sampled_set_says_all_that_its_scans_depend_on():
    street = r2flow.load("street")

    def about(**settings: Any) -> dict[str, Any]:
        return dict(sampled_set(street, "street", 2, street.generator.choose(**settings)).about)

    found = [about(), about(name="sde", churn=2), about(steps=8)]
    found += [about(name="dopri5", tolerance=tolerance) for tolerance in (1e-2, 1e-4)]
    assert all(a != b for i, a in enumerate(found) for b in found[:i])
