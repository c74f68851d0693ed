"""The straight line from noise to data."""

from torch import Tensor


def expand_time(t: Tensor, x: Tensor) -> Tensor:
    """Reshape t, (B,) or (), to broadcast with x, (B, ...)."""
    return t.reshape(-1, *(1,) * (x.ndim - 1)) if t.ndim else t


def interpolate(x_0: Tensor, x_1: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """x_t = (1 - t) x_0 + t x_1 and its velocity u_t = x_1 - x_0 (paper, eq. 1-2); t is (B,)."""
    t = expand_time(t, x_1)
    return (1 - t) * x_0 + t * x_1, x_1 - x_0
