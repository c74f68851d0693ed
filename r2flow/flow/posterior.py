"""Samples given a part of x_1, by a flow that was trained without a condition.

A method of `METHODS` takes the states x_t of a flow from noise at t = 0 to x_1 at t = 1, where the values of a mask are
known. With u = v(t, x_t), x_1hat = x_t + (1 - t) u is the mean E[x_1 | x_t]. With a flow map, `replace` and `repaint`
jump to the next time; `mmps` needs that mean and takes the map's velocity u(x, t, t). docs/completion.md has how far
each is from the posterior where that is known.

    x_1 = sample_posterior(u, x_0, y, known, "mmps", times, noise)
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.maps import MeanVelocity, jump
from r2flow.flow.stochastic import Noise, back, sde
from r2flow.registry import Registry

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
    length: int = 1,
) -> Tensor:
    """`replace` with new noise, which takes every `length` steps `repeats` times (Lugmayr et al. 2022, algorithm 1).

    Before it takes them again it goes back from t' to t by new noise, x_t = (t / t') x_t' + sqrt((1 - t)^2 -
    (t / t')^2 (1 - t')^2) e, which leaves the law of the flow's x_t as it is. The first steps are taken once: at t = 0
    nothing of x_t' is left. Evaluations: N + (repeats - 1) (N - length) for N steps.
    """
    j = 0
    for first in range(0, len(times) - 1, length):
        part = times[first : first + length + 1]
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


class Number(NamedTuple):
    """A number of a method: what it is if it is left out, and the least that it may be."""

    usual: int | float
    least: int | float


@dataclass(frozen=True)
class Method:
    """A way to sample given a part of x_1.

    Attributes:
        run: `run(u, x_0, y, known, times, noise, *numbers)` to x_1.
        evaluations: Network evaluations of a number of steps and the numbers.
        numbers: What may follow the name, as in `repaint:10,2`.
    """

    run: Callable[..., Tensor]
    evaluations: Callable[..., int]
    numbers: tuple[Number, ...] = ()


METHODS: Registry[Method] = Registry(
    "method of completion",
    replace=Method(replace, lambda n: n),
    repaint=Method(
        repaint,
        lambda n, repeats, length: n + (repeats - 1) * max(n - length, 0),
        (Number(4, 1), Number(1, 1)),
    ),
    mmps=Method(mmps, lambda n, products, _: n * (1 + products), (Number(2, 1), Number(1.0, 0.0))),
)


class Chosen(NamedTuple):
    """A method with its numbers."""

    method: Method
    numbers: tuple[int | float, ...]

    def evaluations(self, steps: int) -> int:
        """Network evaluations of a scan, a vector-Jacobian product counting as one."""
        return self.method.evaluations(steps, *self.numbers)


def completes(text: str) -> bool:
    """Whether a sampler's method is one of `METHODS`."""
    return text.partition(":")[0] in METHODS


def methods_in(text: str) -> list[str]:
    """The methods of a list with commas between them, `NAME,NAME:NUMBER,NUMBER,NAME`: no name begins with a number."""
    return re.split(r",\s*(?=[A-Za-z])", text)


def parse_method(text: str) -> Chosen:
    """A method by its text, `NAME` or `NAME:NUMBER,...`.

    Raises:
        InputError: no such method, or numbers that it does not take.
    """
    name, _, given = text.partition(":")
    method = METHODS[name]
    words = given.split(",") if given else []
    try:
        numbers = [type(n.usual)(word) for n, word in zip(method.numbers, words, strict=False)]
        right = len(numbers) == len(words) and all(
            n.least <= number < float("inf") for n, number in zip(method.numbers, numbers, strict=False)
        )
    except ValueError:
        right = False
    if not right:
        usual = ",".join(f"{n.usual:g}" for n in method.numbers)
        raise InputError(f"{name} does not take the numbers of {text!r}: give {name}{usual and ':' + usual}.")
    return Chosen(method, (*numbers, *(n.usual for n in method.numbers[len(numbers) :])))


def sample_posterior(
    u: MeanVelocity, x_0: Tensor, y: Tensor, known: Tensor, method: str, times: Tensor, noise: Noise | None = None
) -> Tensor:
    """x_1 given y, (B, ...); known values as they were given.

    Args:
        u: Mean velocity u(t, x, s) of the flow, at times of shape (): v(t, x) of one that knows no other.
        x_0: Noise, (B, ...).
        y: Known values of x_1, (B, ...); any where `known` is False.
        known: Which values are known, (B, ...) bool.
        method: A name of `METHODS`, with its numbers or without.
        times: Rising from 0 to 1, (N + 1,).
        noise: Further noise; not needed by a method that draws none.

    Raises:
        InputError: no such method, or one that needs noise and has none.
    """
    if torch.is_inference_mode_enabled():  # products with a Jacobian need tensors that autograd may keep
        with torch.inference_mode(False), torch.no_grad():
            return sample_posterior(u, x_0.clone(), y.clone(), known.clone(), method, times.clone(), noise)
    chosen = parse_method(method)

    def missing(j: int) -> Tensor:
        raise InputError(f"{method} draws further noise: give draws.")

    x_1 = chosen.method.run(u, x_0, y, known, times.to(x_0), noise or missing, *chosen.numbers)
    return torch.where(known, y, x_1)
