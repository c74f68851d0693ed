"""Samples given a measurement, by a flow that was trained without one.

The measurement is y = A x_1 + sigma n, n ~ N(0, 1) (`Measurement`). A method of `METHODS` takes the states x_t of a
flow from noise at t = 0 to x_1 at t = 1 and pulls them towards it. All use the flow's estimates of both ends,

    x_1hat = x_t + (1 - t) u,        x_0hat = x_t - t u,        x_t = t x_1hat + (1 - t) x_0hat,

with u = v(t, x_t), where x_1hat is the mean E[x_1 | x_t]. With a flow map, `replace`, `repaint` and `pnp` jump, to the
next time or to the end of the path itself; the others need that mean and take the map's velocity u(x, t, t). No method
is exact for every flow: docs/completion.md has how far each is from the posterior where that is known.

    x_1 = sample_posterior(u, x_0, measured, "mmps", times, noise)
"""

import contextlib
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import replace as changed
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
POWERS = 20  # steps of the power iteration to |A|^2
EARLIEST = 0.1  # time before which `mmps` takes the flow's Jacobian of this time: at t = 0 it is divided by 0


@dataclass(frozen=True)
class Measurement:
    """y = A x_1 + sigma n of each scan, n ~ N(0, 1).

    A is a mask, unless `forward` is given.

    Attributes:
        y: Measured values, (B, ...); any where nothing was measured.
        mask: 1 where a value was measured, 0 elsewhere, as y.
        sigma: Standard deviation of each measured value's error, as y or (): 0 where it is known.
        forward: A x for a linear A, (B, ...) to the shape of y, each scan for itself.
        adjoint: A^T y, back again.
    """

    y: Tensor
    mask: Tensor
    sigma: Tensor
    forward: Linear | None = None
    adjoint: Linear | None = None

    @property
    def known(self) -> Tensor:
        """Which values of x_1 are known, as y, bool."""
        known = (self.mask > 0) & (self.sigma == 0)
        return known if self.forward is None else torch.zeros_like(known)

    def select(self, scans: Tensor) -> "Measurement":
        """That of some of the scans, indices (N,)."""
        sigma = self.sigma[scans] if self.sigma.ndim else self.sigma
        return Measurement(self.y[scans], self.mask[scans], sigma, self.forward, self.adjoint)

    def copied(self) -> "Measurement":
        """The same with copies of its tensors."""
        return changed(self, y=self.y.clone(), mask=self.mask.clone(), sigma=self.sigma.clone())

    def squared_norm(self, x: Tensor) -> Tensor:
        """|A|^2, the largest factor by which A^T A makes a scan longer, of each scan, (B, 1, ...).

        1 for a mask; of any other A by `POWERS` steps of power iteration from x, (B, ...).
        """
        if self.forward is None:
            return torch.ones(())
        found = torch.zeros(())
        for _ in range(POWERS):
            longer = self.transposed(self.apply(x))
            found = _dot(longer, longer).sqrt()
            x = longer / found.clamp(min=torch.finfo(x.dtype).tiny)
        return found

    def apply(self, x: Tensor) -> Tensor:
        """A x."""
        return self.mask * (x if self.forward is None else self.forward(x))

    def transposed(self, d: Tensor) -> Tensor:
        """A^T d."""
        return self.mask * d if self.adjoint is None else self.adjoint(self.mask * d)

    def residual(self, x: Tensor) -> Tensor:
        """y - A x, 0 where nothing was measured."""
        return self.mask * self.y - self.apply(x)

    def pull(self, x: Tensor, variance: Tensor) -> Tensor:
        """A^T (r^2 A A^T + sigma^2)^-1 (y - A x): the gradient of log p(y | x_1hat = x) where x_1 ~ N(x_1hat, r^2).

        Args:
            x: x_1hat, (B, ...).
            variance: r^2 > 0, ().
        """
        residual = self.residual(x)
        if self.forward is None:
            return residual / torch.where(self.mask > 0, variance + self.sigma**2, 1)

        def multiply(p: Tensor) -> tuple[Tensor, Tensor]:
            back = self.transposed(p)
            return back, variance * self.apply(back) + self.sigma**2 * p

        return _solved(multiply, residual, 50)

    def corrected(self, x: Tensor, variance: Tensor) -> Tensor:
        """x + r^2 `pull`: the mean of x_1 ~ N(x, r^2) given y. A known value is y."""
        return self.exact(x + variance * self.pull(x, variance))

    def exact(self, x: Tensor) -> Tensor:
        """x with the known values as they were given; through `forward` none of its values is one of y's."""
        return x if self.forward is not None else torch.where(self.known, self.y, x)

    def on_path(self, t: Tensor, x: Tensor, e: Tensor) -> Tensor:
        """x_t with its measured values replaced by t y + sqrt((1 - t)^2 - (t sigma)^2) e.

        That is x_t = t x_1 + (1 - t) x_0 in law: the measurement's own error is a part of the noise. It is all of it
        at t = 1 / (1 + sigma); later, y is noisier than x_t and nothing is replaced.
        """
        left = (1 - t) ** 2 - (t * self.sigma) ** 2
        return torch.where((self.mask > 0) & (left >= 0), t * self.y + left.clamp(min=0).sqrt() * e, x)


def _variance(t: Tensor) -> Tensor:
    """Var(x_1 | x_t) = (1 - t)^2 / ((1 - t)^2 + t^2) if x_1 ~ N(0, 1), what methods without a Jacobian assume."""
    return (1 - t) ** 2 / ((1 - t) ** 2 + t**2)


def replace(u: MeanVelocity, x: Tensor, measured: Measurement, times: Tensor, noise: Noise) -> Tensor:
    """Euler steps, after each of which the measured values lie on the line from this scan's own noise to y.

    x_t' = M (t' y + (1 - t') x_0) + (1 - M) (x_t + (t' - t) u). What is not measured learns of y only through the
    network. One evaluation a step, no noise.
    """
    x_0 = x
    for t, s in pairwise(times):
        x = measured.on_path(s, jump(u, t, x, s), x_0)
    return x


def replace_fresh(u: MeanVelocity, x: Tensor, measured: Measurement, times: Tensor, noise: Noise) -> Tensor:
    """`replace` with other noise at each step (Song et al. 2021, score-based generative modeling, app. I.2).

    One evaluation a step.
    """
    for j, (t, s) in enumerate(pairwise(times), start=1):
        x = measured.on_path(s, jump(u, t, x, s), noise(j))
    return x


def repaint(
    u: MeanVelocity, x: Tensor, measured: Measurement, times: Tensor, noise: Noise, repeats: int = 4, length: int = 1
) -> Tensor:
    """`replace_fresh` that takes every `length` steps `repeats` times (Lugmayr et al. 2022, RePaint, algorithm 1).

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
                x = measured.on_path(s, jump(u, t, x, s), noise(j))
    return x


def flowdps(u: MeanVelocity, x: Tensor, measured: Measurement, times: Tensor, noise: Noise) -> Tensor:
    """Both ends apart: the measurement corrects x_1hat, new noise enters x_0hat (Kim et al. 2025, FlowDPS, alg. 1).

    x_1' = t x_1hat + (1 - t) x_1y with x_1y = `corrected` x_1hat, then
    x_t' = t' x_1' + (1 - t') (sqrt(1 - t') x_0hat + sqrt(t') e). The paper takes three gradient steps to x_1y, this
    is where they lead. One evaluation a step.
    """
    for j, (t, s) in enumerate(pairwise(times), start=1):
        v = u(t, x, t)
        x_1, x_0 = x + (1 - t) * v, x - t * v
        x_1 = t * x_1 + (1 - t) * measured.corrected(x_1, _variance(t))
        x = s * x_1 + (1 - s) * ((1 - s).sqrt() * x_0 + s.sqrt() * noise(j))
    return x


def pnp(u: MeanVelocity, x: Tensor, measured: Measurement, times: Tensor, noise: Noise, repeats: int = 5) -> Tensor:
    """The flow as a denoiser in a descent on |A x - y|^2 / 2 (Martin et al. 2025, PnP-Flow, algorithm 3).

    z = x - (1 - t)^a A^T (A x - y) / L, then x = mean of D_t(t z + (1 - t) e) over `repeats` draws of e, with
    D_t(x) = x + (1 - t) u, a = 1/2 and L = max(1, |A|^2): the paper's A have |A| = 1, and from |A|^2 = 2 on a step of
    L = 1 leads away. It looks for one good x_1 and does not sample; sigma does not enter. `repeats` evaluations a step.
    """
    largest = measured.squared_norm(x).clamp(min=1)
    for j, t in enumerate(times[:-1]):
        z = x + (1 - t).sqrt() / largest * measured.transposed(measured.residual(x))
        found = [t * z + (1 - t) * noise(j * repeats + k) for k in range(1, repeats + 1)]
        x = sum((jump(u, t, y, torch.ones_like(t)) for y in found), torch.zeros_like(x)) / repeats
    return x


def ot_ode(
    u: MeanVelocity, x: Tensor, measured: Measurement, times: Tensor, noise: Noise, start: float = 0.2
) -> Tensor:
    """The flow with the gradient of log p(y | x_t) (Pokle et al. 2024, training-free linear image inverses via flows).

    v' = u + ((1 - t) / t) J^T h with J = d x_1hat / d x_t, h = A^T (r^2 A A^T + sigma^2)^-1 (y - A x_1hat) and
    r^2 = (1 - t)^2 / ((1 - t)^2 + t^2), as in PiGDM (Song et al. 2023). With the exact v and x_1 ~ N(m, 1) this is the
    posterior's own velocity. Euler steps go from `start` on, where x = start A^T y + (1 - start) x_0.
    One evaluation a step and one vector-Jacobian product, which counts as another.
    """
    x = start * measured.transposed(measured.y) + (1 - start) * x
    for t, s in pairwise(start + (1 - start) * times):
        x_1, product = _linearised(u, t, x)
        h = measured.pull(x_1, _variance(t))
        x = x + (s - t) * ((x_1 - x) / (1 - t) + (1 - t) / t * product(h))
    return x


def mmps(
    u: MeanVelocity,
    x: Tensor,
    measured: Measurement,
    times: Tensor,
    noise: Noise,
    products: int = 2,
    churn: float = 1.0,
) -> Tensor:
    """The flow's own covariance in the place of r^2 (Rozet et al. 2024, moment matching posterior sampling).

    Cov(x_1 | x_t) = C = ((1 - t)^2 / t) J, the second-order Tweedie formula, so that
    E[x_1 | x_t, y] = x_1hat + C A^T (A C A^T + sigma^2)^-1 (y - A x_1hat), which is exact where x_1 is Gaussian given
    x_t. The linear system is solved by `products` steps of conjugate gradients (`_solved`), each one product with J;
    where C is not positive in a direction, as a network's may be, they end. With that mean `r2flow.flow.stochastic.sde`
    takes the steps, with `churn` times the reversed diffusion's fresh noise: 0 is the ODE.
    Evaluations: 1 + `products` a step, a vector-Jacobian product counting as one.
    """

    def mean(t: Tensor, x: Tensor) -> Tensor:
        at = t.clamp(min=EARLIEST)
        x_1, product = _linearised(u, at, x * ((1 - at) / (1 - t)))

        def multiply(p: Tensor) -> tuple[Tensor, Tensor]:
            moved = (1 - at) ** 2 / at * product(measured.transposed(p))
            return moved, measured.apply(moved) + measured.sigma**2 * p

        return measured.exact(x_1 + _solved(multiply, measured.residual(x_1), products))

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
    """A number of a method: what it is if it is left out, what it must be, and that in words."""

    usual: int | float
    valid: Callable[[float], bool]
    says: str


def _whole(usual: int) -> Number:
    return Number(usual, lambda n: n >= 1, "a whole number of at least 1")


@dataclass(frozen=True)
class Method:
    """A way to sample given a measurement.

    Attributes:
        run: `run(u, x_0, measured, times, noise, *numbers)` to x_1.
        evaluations: Network evaluations of a number of steps and the numbers.
        numbers: What may follow the name, as in `repaint:10,2`.
        masks: Whether it takes masks alone, and no other linear A.
    """

    run: Callable[..., Tensor]
    evaluations: Callable[..., int]
    numbers: tuple[Number, ...] = ()
    masks: bool = False


METHODS: Registry[Method] = Registry(
    "method of completion",
    replace=Method(replace, lambda n: n, masks=True),
    replace_fresh=Method(replace_fresh, lambda n: n, masks=True),
    repaint=Method(
        repaint, lambda n, repeats, length: n + (repeats - 1) * max(n - length, 0), (_whole(4), _whole(1)), True
    ),
    flowdps=Method(flowdps, lambda n: n),
    pnp=Method(pnp, lambda n, repeats: n * repeats, (_whole(5),)),
    ot_ode=Method(ot_ode, lambda n, start: 2 * n, (Number(0.2, lambda n: 0 < n < 1, "a start in (0, 1)"),)),
    mmps=Method(
        mmps,
        lambda n, products, _: n * (1 + products),
        (_whole(2), Number(1.0, lambda c: 0 <= c < math.inf, "a share of fresh noise of at least 0")),
    ),
)


class Chosen(NamedTuple):
    """A method with its numbers."""

    called: str
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
    method, numbers = METHODS[name], []
    words = given.split(",") if given else []
    with contextlib.suppress(ValueError):
        numbers = [type(number.usual)(word) for number, word in zip(method.numbers, words, strict=False)]
    right = all(number.valid(n) for number, n in zip(method.numbers, numbers, strict=False))
    if len(numbers) != len(words) or not right:
        usual = (
            ":" + ",".join(f"{number.usual:g}" for number in method.numbers) if method.numbers else " without numbers"
        )
        takes = " and ".join(dict.fromkeys(number.says for number in method.numbers))
        takes = f" ({takes})" if takes else ""
        raise InputError(f"the numbers of {text!r} are none that {name} takes{takes}: give {name}{usual}.")
    return Chosen(name, method, (*numbers, *(number.usual for number in method.numbers[len(numbers) :])))


def sample_posterior(
    u: MeanVelocity, x_0: Tensor, measured: Measurement, method: str, times: Tensor, noise: Noise | None = None
) -> Tensor:
    """x_1 given y, (B, ...); known values as they were given.

    Args:
        u: Mean velocity u(t, x, s) of the flow, at times of shape (): v(t, x) of one that knows no other.
        x_0: Noise, (B, ...).
        method: A name of `METHODS`, with its numbers or without.
        times: Rising from 0 to 1, (N + 1,).
        noise: Further noise; not needed by a method that draws none.

    Raises:
        InputError: no such method, one that needs noise or a mask and has none.
    """
    if torch.is_inference_mode_enabled():  # products with a Jacobian need tensors that autograd may keep
        with torch.inference_mode(False), torch.no_grad():
            return sample_posterior(u, x_0.clone(), measured.copied(), method, times.clone(), noise)
    chosen = parse_method(method)
    if chosen.method.masks and measured.forward is not None:
        others = ", ".join(name for name, one in METHODS.items() if not one.masks)
        raise InputError(f"{chosen.called} is for masks alone; for another measurement give {others}.")

    def missing(j: int) -> Tensor:
        raise InputError(f"{method} draws further noise: give draws.")

    return measured.exact(chosen.method.run(u, x_0, measured, times.to(x_0), noise or missing, *chosen.numbers))
