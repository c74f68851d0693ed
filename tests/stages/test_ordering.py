"""The paper's ordering on the plane, where the exact 1-RF is known: a small benchmarks/ordering.py."""

import pytest
import torch

from benchmarks import ordering
from r2flow.flow.solvers import solve


@pytest.fixture(scope="module")
def found() -> dict[str, float]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ordering, "PLANE_STEPS", {"rectify": 1500, "reflow": 1200, "distill": 1000})
        patch.setattr(ordering, "PLANE_BATCH", 256)
        patch.setattr(ordering, "PLANE_PAIRS", 8000)
        patch.setattr(ordering, "PLANE_SAMPLES", 4096)
        return ordering.plane(seed=7)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(6))
def test_each_of_the_paper_s_statements_holds(found: dict[str, float], number: int):
    claim = ordering.claims([found])[number]
    assert claim["margins"][0] > 0, claim
    assert claim["verdict"] == "cannot tell"  # from one seed


def test_the_exact_velocity_carries_noise_to_the_data():
    draw = torch.Generator().manual_seed(0)
    x_0 = torch.randn(4096, 1, 1, 2, generator=draw, dtype=torch.float64)
    end = solve(ordering.plane_velocity, x_0, method="dopri5", tolerance=1e-7).x.float()
    data = ordering.plane_data(4096, draw)
    floor = ordering.sliced_distance(ordering.plane_data(4096, draw), data)
    assert ordering.sliced_distance(end, data) < 2 * floor
