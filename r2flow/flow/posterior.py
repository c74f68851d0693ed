"""Samples given a part of x_1, by a flow that was trained without a condition.

A method takes the states x_t of a flow from noise at t = 0 to x_1 at t = 1, where the values of a mask are
known. With u = v(t, x_t), x_1hat = x_t + (1 - t) u is the mean E[x_1 | x_t]. With a flow map, `replace` and `repaint`
jump to the next time; `mmps` needs that mean and takes the map's velocity u(x, t, t). docs/completion.md has how far
each is from the posterior where that is known.

    x_1 = mmps(u, x_0, y, known, times, noise)
"""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from r2flow.flow.maps import MeanVelocity, jump
from r2flow.flow.stochastic import Noise, back, sde

Linear = Callable[[Tensor], Tensor]

GROWN = 10.0  # of |y - A x_1hat|^2: docs/completion.md
EARLIEST = 0.1  # time before which `mmps` takes the flow's Jacobian of this time: at t = 0 it is divided by 0


def replace(u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Noise) -> Tensor:
    """Euler steps, after each of which the known values lie on the line from this scan's own noise to y.

    x_t' = M (t' y + (1 - t') x_0) + (1 - M) (x_t + (t' - t) u). One evaluation a step, no noise.
    """
    x_0 = x
    for t, s in pairwise(times):
        x = torch.where(known, s * y + (1 - s) * x_0, jump(u, t, x, s))
    return x


def repaint(
    u: MeanVelocity,
    x: Tensor,
    y: Tensor,
    known: Tensor,
    times: Tensor,
    noise: Noise,
    repeats: int = 4,
    parts: int = 1,
) -> Tensor:
    """`replace` with new noise, which takes every step of `parts` parts `repeats` times (Lugmayr et al. 2022, alg. 1).

    Before it takes them again it goes back from t' to t by new noise, x_t = (t / t') x_t' + sqrt((1 - t)^2 -
    (t / t')^2 (1 - t')^2) e, which leaves the law of the flow's x_t as it is. The first step is taken once: at t = 0
    nothing of x_t' is left. Evaluations: parts (1 + repeats (N - 1)) for N steps.
    """
    j = 0
    for first in range(0, len(times) - 1, parts):
        part = times[first : first + parts + 1]
        for again in range(repeats if first else 1):
            if again:
                j += 1
                x = back(x, float(part[-1]), float(part[0]), noise(j))
            for t, s in pairwise(part):
                j += 1
                x = torch.where(known, s * y + (1 - s) * noise(j), jump(u, t, x, s))
    return x


def mmps(
    u: MeanVelocity,
    x: Tensor,
    y: Tensor,
    known: Tensor,
    times: Tensor,
    noise: Noise,
    products: int = 2,
    churn: float = 1.0,
) -> Tensor:
    """The posterior mean by the flow's own covariance (Rozet et al. 2024, moment matching posterior sampling).

    Cov(x_1 | x_t) = C = ((1 - t)^2 / t) J with J = d x_1hat / d x_t, the second-order Tweedie formula, so that
    E[x_1 | x_t, y] = x_1hat + C A^T (A C A^T)^-1 (y - A x_1hat), which is exact where x_1 is Gaussian given x_t. The
    linear system is solved by `products` steps of conjugate gradients (`_solved`), each one product with J; where C is
    not positive in a direction, as a network's may be, they end. With that mean `r2flow.flow.stochastic.sde` takes the
    steps, with `churn` times the reversed diffusion's fresh noise: 0 is the ODE.
    Evaluations: 1 + `products` a step, a vector-Jacobian product counting as one.
    """

    def mean(t: Tensor, x: Tensor) -> Tensor:
        at = t.clamp(min=EARLIEST)
        x_1, product = _linearised(u, at, x * ((1 - at) / (1 - t)))

        def multiply(p: Tensor) -> tuple[Tensor, Tensor]:
            moved = (1 - at) ** 2 / at * product(p)
            return moved, known * moved

        residual = torch.where(known, y - x_1, 0)
        return torch.where(known, y, x_1 + _solved(multiply, residual, products))

    *_, x = sde(mean, x, times, churn, noise)
    return x


def _linearised(u: MeanVelocity, t: Tensor, x: Tensor) -> tuple[Tensor, Linear]:
    """x_1hat at x_t and the product J^T z with J = d x_1hat / d x_t."""
    with torch.enable_grad():
        at = x.detach().requires_grad_()
        x_1 = at + (1 - t) * u(t, at, t)

    def product(z: Tensor) -> Tensor:
        return torch.autograd.grad(x_1, at, z, retain_graph=True)[0]

    return x_1.detach(), product


def _solved(multiply: Callable[[Tensor], tuple[Tensor, Tensor]], r: Tensor, steps: int) -> Tensor:
    """B S^-1 r for a positive S, each scan for itself, with `multiply(p)` = (B p, S p).

    By conjugate gradients or, where these have left more than `GROWN` r r, by the combination of the same directions
    that leaves the least: a network's J is not quite symmetric, and their residual may then grow without end. A scan
    ends where its residual is 0 to rounding, or in a direction in which S is not positive.
    """
    p, rr, found = r, _dot(r, r), torch.zeros(())
    goes = torch.ones_like(rr, dtype=torch.bool)
    enough, most = torch.finfo(r.dtype).eps ** 2 * rr, GROWN * rr
    rest, least = r, torch.zeros(())
    last: tuple[Tensor, Tensor] | None = None  # the direction before, S p orthogonal to the others' and of length 1
    for _ in range(steps):
        moved, q = multiply(p)
        curvature = _dot(p, q)
        goes = goes & (rr > enough) & (curvature > 0)
        step = torch.where(goes, rr / curvature, 0)
        found, r = found + step * moved, r - step * q
        former, rr = rr, _dot(r, r)
        p = r + torch.where(goes, rr / former, 0) * p
        if last is not None:
            share = _dot(last[1], q)
            moved, q = moved - share * last[0], q - share * last[1]
        length = _dot(q, q).sqrt()
        goes = goes & (length > 0)
        last = torch.where(goes, moved / length, 0), torch.where(goes, q / length, 0)
        share = _dot(rest, last[1])
        least, rest = least + share * last[0], rest - share * last[1]
    return torch.where(rr <= most, found, least)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Sum of a b over each scan, (B, 1, ...)."""
    return (a * b).flatten(1).sum(1).view(-1, *(1,) * (a.ndim - 1))
