import numpy as np
import pytest
import torch

from r2flow.lidar.neighbours import nearest_returns

STEPS = torch.tensor([[0.8, 0.35], [0.3, 0.5]])


def by_search(returned: np.ndarray, steps: np.ndarray, ring: bool) -> np.ndarray:
    """The least angle to a return in each of the four quarters, (4, H, W), of all pairs of pixels."""
    rows, columns = returned.shape
    i, j = np.nonzero(returned)
    if ring:
        i, j = np.tile(i, 3), np.concatenate([j - columns, j, j + columns])
    least = np.full((4, rows, columns), np.inf)
    for row in range(rows):
        for column in range(columns):
            down, aside = i - row, j - column
            apart = np.hypot(down * steps[0], aside * steps[1])
            quarters = (
                (down < 0) & (abs(aside) <= -down), (down > 0) & (aside**2 <= down**2),
                (aside < 0) & (abs(down) <= -aside), (aside > 0) & (down**2 <= aside**2),
            )  # fmt: skip
            for quarter, inside in enumerate(quarters):
                least[quarter, row, column] = apart[inside].min(initial=np.inf)
    return least


@pytest.mark.parametrize("ring", [True, False])
@pytest.mark.parametrize("share", [0.02, 0.2, 0.6])
def test_the_nearest_return_of_each_quarter_is_that_of_a_search(share, ring):
    returned = torch.rand(2, 9, 16, generator=torch.Generator().manual_seed(3)) < share
    found = nearest_returns(returned, STEPS, ring)
    apart = torch.linalg.vector_norm(found * STEPS.T[None, :, :, None, None], dim=1)
    for image in range(2):
        expected = by_search(returned[image].numpy(), STEPS[image].numpy(), ring)
        assert np.allclose(apart[:, image], expected, rtol=1e-5)


def test_offsets_lead_to_returns_on_the_side_that_is_asked_for():
    returned = torch.rand(2, 9, 16, generator=torch.Generator().manual_seed(4)) < 0.2
    found = nearest_returns(returned, STEPS)
    there = found.isfinite().all(1)
    down, aside = torch.where(there[:, None], found, 0).long().unbind(1)
    row, column = torch.arange(9)[:, None] + down, (torch.arange(16) + aside) % 16
    hit = returned[torch.arange(2)[None, :, None, None].expand_as(row), row, column]
    sides = torch.stack([down[0] < 0, down[1] > 0, aside[2] < 0, aside[3] > 0])
    assert there.any()
    assert (hit & sides)[there].all()


def test_where_nothing_returned_there_is_no_neighbour():
    assert nearest_returns(torch.zeros(2, 4, 8, dtype=torch.bool), STEPS).isinf().all()
