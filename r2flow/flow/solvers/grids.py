"""Time grids of fixed steps."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from r2flow.errors import InputError, check


def uniform(t_0: float, t_1: float, steps: int) -> Tensor:
    """Equal steps; (steps + 1,) float64."""
    return torch.linspace(t_0, t_1, steps + 1, dtype=torch.float64)


def power(t_0: float, t_1: float, steps: int, p: float) -> Tensor:
    """t = 1 - (1 - u)^p at equal steps of u: for p > 1 denser towards t = 1, where a 1-RF is most curved."""
    check(max(t_0, t_1) <= 1, "a power grid ends at the time towards which it gets denser: give grid=uniform.")
    return 1 - uniform((1 - t_0) ** (1 / p), (1 - t_1) ** (1 / p), steps) ** p


def named_grid(name: str) -> Callable[[float, float, int], Tensor]:
    """A time grid by name, uniform or power:P with 1 <= P <= 10, the same forward and backward in time."""
    if name == "uniform":
        return uniform
    kind, _, text = name.partition(":")
    try:
        p = float(text)
    except ValueError:
        p = math.nan
    check(kind == "power" and 1 <= p <= 10, f"a time grid is uniform or power:P with P from 1 to 10; found {name!r}.")
    return lambda t_0, t_1, steps: power(t_0, t_1, steps, p)


def build_grid(grid: str | Sequence[float] | Tensor, t_0: float, t_1: float, steps: int) -> Tensor:
    """Times from t_0 to t_1, (N + 1,) float64 on the CPU; N = steps unless `grid` has the times."""
    if isinstance(grid, str):
        times = named_grid(grid)(t_0, t_1, steps)
    else:
        times = torch.as_tensor(grid, dtype=torch.float64, device="cpu").detach().clone()
    one_way = times.ndim == 1 and len(times) > 1 and bool((times.diff() * (t_1 - t_0) > 0).all())
    if not one_way or max(abs(times[0] - t_0), abs(times[-1] - t_1)) > 1e-6:
        given = grid if not isinstance(grid, str) else f"{steps} steps on {grid}, too short for float64"
        raise InputError(f"a time grid must be (N + 1,) times one way from {t_0:g} to {t_1:g}, found {given}.")
    times[0], times[-1] = t_0, t_1  # undo rounding by float32 or powers
    return times
