"""The nearest known returns of each ray."""

import math

import torch
from torch import Tensor


def nearest_returns(returned: Tensor, steps: Tensor, ring: bool = True) -> Tensor:
    """Rows and columns from each ray to the nearest returns above, below, left and right, (4, 2, B, H, W) float32.

    `Above` is the quadrant of previous rows whose distance in columns is at most the distance in rows; the others are
    alike. Of the returns, (B, H, W) bool, the nearest has the smallest angle, by the angles between two rows and
    between two columns, (B, 2). Offsets are infinite without a return. `ring`: the columns are a full turn.
    """
    twice = steps.repeat(2, 1).mT[..., None]  # (2, 2 B, 1)
    upright = torch.stack([returned, returned.flip(1)]).flatten(0, 1)
    above, below = _before(upright, twice, ring).unflatten(1, (2, -1)).unbind(1)
    level = torch.stack([returned, returned.flip(2)]).flatten(0, 1).mT
    turn = level.shape[1]
    if ring:  # two turns: the last columns precede the first
        level = torch.cat([level, level], dim=1)
    left, right = _before(level, twice.flip(0), False)[:, :, -turn:].mT.flip(0).unflatten(1, (2, -1)).unbind(1)
    upward = steps.new_tensor([-1, 1])[:, None, None, None]  # the opposite direction of rows
    return torch.stack([above, below.flip(2) * upward, left, right.flip(3) * -upward])


def _before(returned: Tensor, steps: Tensor, ring: bool) -> Tensor:
    """Offsets to the nearest return in the quadrant of previous rows, (2, B, H, W), row by row."""
    batch, rows, columns = returned.shape
    missing = torch.full((2, batch, columns), math.inf, device=returned.device)
    move = torch.tensor([[-1.0, -1.0], [-1.0, 0.0], [-1.0, 1.0]], device=returned.device)[..., None, None]
    offsets, state = [missing], torch.where(returned[:, 0], 0.0, missing)
    for row in range(1, rows):
        wide = torch.cat(
            [state[..., -1:], state, state[..., :1]] if ring else [missing[..., :1], state, missing[..., :1]], -1
        )
        candidates = wide.unfold(-1, columns, 1).permute(2, 0, 1, 3) + move
        best = (candidates * steps).square().sum(1).argmin(0)
        nearest = candidates.gather(0, best.expand(1, 2, *best.shape))[0]
        offsets.append(nearest)
        state = torch.where(returned[:, row], 0.0, nearest)
    return torch.stack(offsets, dim=2)
