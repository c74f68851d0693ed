"""How often an adaptive solver is wrong without saying so: problems of 50 kinds with known ends.

A silent failure: the solution has converged, is not flagged as stiff, and is further from the exact end than
30 tolerances x (1 + RMS of the exact end). Every kind has three scenes with parameters drawn at random; float64, 16
elements a scene, no limit on the steps, no error estimate.

python benchmarks/silent_failures.py                       # the table, a minute or two on one core
python benchmarks/silent_failures.py --max-step 0.05       # with a limit on the longest step
"""

import argparse
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.flow.problems import (
    Anisotropic,
    Gaussian,
    GaussianMixture,
    Mixed,
    NarrowJet,
    PointMass,
    Problem,
    RayDrop,
    Rotating,
    StiffLinear,
    Straight,
    TwoModes,
)
from r2flow.flow.solvers import solve

FAILS_AT = 30.0  # tolerances
METHODS = ("dopri5", "bosh3")
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5)
SCENES, ELEMENTS = 3, 16

Rng = np.random.Generator


class Event(NamedTuple):
    """g(t), and the times between which it is smooth."""

    g: Callable[[Tensor], Tensor]
    breaks: tuple[float, ...]


def box(at: float, width: float) -> Event:
    a, b = at - width / 2, at + width / 2
    return Event(lambda t: ((t >= a) & (t < b)) / width, (a, b))


def hump(at: float, width: float) -> Event:
    """cos^2, 0 outside its width."""
    a, b = at - width / 2, at + width / 2
    return Event(
        lambda t: torch.where((t >= a) & (t < b), 1 + torch.cos(2 * math.pi * (t - at) / width), 0 * t) / width, (a, b)
    )


def bell(at: float, std: float) -> Event:
    return Event(
        lambda t: torch.exp(-0.5 * ((t - at) / std) ** 2) / (std * math.sqrt(2 * math.pi)),
        tuple(at + k * std for k in range(-8, 9)),
    )


def jump(at: float, by: float) -> Event:
    return Event(lambda t: by * (t >= at), (at,))


def kink(at: float, by: float) -> Event:
    return Event(lambda t: by * (t - at).clamp(min=0), (at,))


def root(at: float, by: float) -> Event:
    return Event(lambda t: by * (t - at).abs().sqrt(), tuple(at + s * 10.0**-k for k in range(1, 13) for s in (-1, 1)))


def both(*events: Event) -> Event:
    return Event(lambda t: sum((e.g(t) for e in events), 0 * t), tuple(b for e in events for b in e.breaks))


class Base(NamedTuple):
    """x' = rate(t) x + drift(t): s(t) solves s' = rate s, p(t) the whole."""

    rate: Callable[[Tensor], Tensor]
    drift: Callable[[Tensor], Tensor]
    s: Callable[[Tensor], Tensor]
    p: Callable[[Tensor], Tensor]


def _gaussian_base(std: float, mean: float = 0.7) -> Base:
    def rate(t: Tensor) -> Tensor:
        return (t * std**2 - (1 - t)) / ((1 - t) ** 2 + (t * std) ** 2)

    return Base(
        rate, lambda t: mean - rate(t) * t * mean, lambda t: ((1 - t) ** 2 + (t * std) ** 2).sqrt(), lambda t: t * mean
    )


BASES = {
    "rest": Base(lambda t: 0 * t, lambda t: 0 * t, torch.ones_like, torch.zeros_like),  # a quadrature
    "decay": Base(lambda t: 0 * t - 1, lambda t: 0 * t, lambda t: (-t).exp(), torch.zeros_like),
    "wave": Base(lambda t: 0 * t, lambda t: torch.cos(5 * t), torch.ones_like, lambda t: torch.sin(5 * t) / 5),
    "flow": _gaussian_base(0.25),
}
NODES, WEIGHTS = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(40))


class Forced(Problem):
    """x' = rate(t) x + drift(t) + g(t): x_1 = p_1 + s_1 ((x_0 - p_0) / s_0 + integral of g / s)."""

    def __init__(self, base: str, event: Event) -> None:
        self.base, self.event = BASES[base], event

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        t = expand_time(t, x)
        return self.base.rate(t) * x + (self.base.drift(t) + self.event.g(t)).to(x.dtype)

    def solution(self, x_0: Tensor, t: Tensor | float) -> Tensor:
        ends = sorted({0.0, 1.0, *(b for b in self.event.breaks if 0 < b < 1)})
        ends = [a + (b - a) * k / 4 for a, b in pairwise(ends) for k in range(4)] + [1.0]
        total = x_0.new_zeros((), dtype=torch.float64)
        for a, b in pairwise(ends):
            s = a + (b - a) * (NODES + 1) / 2
            total = total + (WEIGHTS * self.event.g(s) / self.base.s(s)).sum() * (b - a) / 2
        zero, one = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
        return self.base.p(one) + self.base.s(one) * ((x_0 - self.base.p(zero)) / self.base.s(zero) + total)


class Given(Problem):
    """A velocity and its end in one line each."""

    def __init__(self, v: Callable[[Tensor, Tensor], Tensor], end: Callable[[Tensor], Tensor]) -> None:
        self.v, self.end = v, end

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        return self.v(expand_time(t, x), x).to(x.dtype)

    def solution(self, x_0: Tensor, t: Tensor | float) -> Tensor:
        return self.end(x_0.double())


def _through_a_wall(rng: Rng) -> Problem:
    """v = 1 below the wall at x = c, 3 above it: a jump in x."""
    c = rng.uniform(2.0, 2.4)  # every element starts below and most pass

    def end(x: Tensor) -> Tensor:
        y = x.clamp(-2, 2)
        return torch.where(y + 1 < c, y + 1, c + 3 * (1 - (c - y)))

    return Given(lambda t, x: 1 + 2 * (x >= c), lambda x: end(x))


def _ramp(rng: Rng) -> Problem:
    """v = max(x, c) / 2 - c / 2 + 1, a kink in x."""
    c = rng.uniform(2.2, 2.8)

    def end(x: Tensor) -> Tensor:
        left = (1 - (c - x)).clamp(min=0)  # time after c is reached
        return torch.where(x + 1 < c, x + 1, c + 2 * torch.expm1(left / 2))

    return Given(lambda t, x: 1 + (x - c).clamp(min=0) / 2, end)


def _sized(rng: Rng, of: float) -> float:
    return float(rng.uniform(0.5, 1.0) * of * rng.choice([-1, 1]))


def _stack(rates: Sequence[float]) -> Problem:
    r = torch.tensor(rates, dtype=torch.float64).repeat(ELEMENTS // len(rates))
    return Given(lambda t, x: -r * (x - 1), lambda x: 1 + (x - 1) * (-r).exp())


def _fast(rng: Rng) -> Problem:
    w = rng.uniform(50, 100)
    return Given(lambda t, x: torch.cos(w * t) + 0 * x, lambda x: x + math.sin(w) / w)


def _cubic(rng: Rng) -> Problem:
    a = rng.uniform(1, 20)
    return Given(lambda t, x: -a * x**3, lambda x: x / (1 + 2 * a * x**2).sqrt())


def _logistic(rng: Rng) -> Problem:
    """Of |x|: x = 1 / (1 + (1 / x_0 - 1) e^-at)."""
    a = rng.uniform(1, 8)
    return Given(
        lambda t, x: a * (y := x.abs()) * (1 - y) * x.sign(),
        lambda x: x.sign() / (1 + (1 / x.abs() - 1) * math.exp(-a)),
    )


def _blow_up(rng: Rng) -> Problem:
    """Starts below 2 and would be infinite after t = 1."""
    a = rng.uniform(0.5, 0.9) / 3
    return Given(lambda t, x: a * x.clamp(max=1e3) ** 2, lambda x: x / (1 - a * x))


def _cancelling(rng: Rng, base: str, by: float, apart: float) -> Problem:
    at = rng.uniform(0.1, 0.7)
    return Forced(base, both(jump(at, by), jump(at + apart, -by)))


KINDS: dict[str, Callable[[Rng], Problem]] = {
    **{
        f"{shape.__name__} {width:g}, {base}": lambda r, s=shape, w=width, b=base: Forced(
            b, s(r.uniform(0.15, 0.85), w)
        )
        for shape, width, base in (
            (box, 0.2, "rest"),
            (box, 0.2, "decay"),
            (box, 0.2, "flow"),
            (hump, 0.2, "rest"),
            (hump, 0.2, "wave"),
            (box, 0.05, "rest"),
            (box, 0.05, "decay"),
            (box, 0.05, "flow"),
            (hump, 0.05, "rest"),
            (hump, 0.05, "wave"),
            (box, 0.01, "rest"),
            (box, 0.01, "flow"),
            (hump, 0.01, "decay"),
            (bell, 0.01, "rest"),
            (bell, 0.05, "rest"),
        )
    },
    "jump, rest": lambda r: Forced("rest", jump(r.uniform(0.05, 0.95), _sized(r, 3))),
    "jump, decay": lambda r: Forced("decay", jump(r.uniform(0.05, 0.95), _sized(r, 3))),
    "jump, wave": lambda r: Forced("wave", jump(r.uniform(0.05, 0.95), _sized(r, 1))),
    "jump, flow": lambda r: Forced("flow", jump(r.uniform(0.05, 0.95), _sized(r, 3))),
    "small jump, wave": lambda r: Forced("wave", jump(r.uniform(0.05, 0.95), _sized(r, 0.1))),
    "two jumps, decay": lambda r: Forced("decay", both(jump(r.uniform(0.1, 0.5), 2.0), jump(r.uniform(0.5, 0.9), 1.0))),
    "jumps that cancel, rest": lambda r: _cancelling(r, "rest", 1.0, 0.18),
    "jumps that cancel, flow": lambda r: _cancelling(r, "flow", 2.0, 0.2),
    "jump from rest": lambda r: Forced("rest", jump(r.uniform(0.5, 0.99), 1.0)),
    "kink": lambda r: Forced("wave", kink(r.uniform(0.1, 0.9), _sized(r, 10))),
    "square root": lambda r: Forced("decay", root(r.uniform(0.1, 0.9), _sized(r, 2))),
    "quadrature, fast": _fast,
    "late rise": lambda r: Given(lambda t, x: 20 * torch.exp(20 * (t - 1)) + 0 * x, lambda x: x - math.expm1(-20)),
    "switch": lambda r: Given(lambda t, x: torch.tanh((t - 0.5) * 100) + 0 * x, lambda x: x),
    "wall in x": _through_a_wall,
    "kink in x": _ramp,
    "cubic": _cubic,
    "logistic": _logistic,
    "blow-up": _blow_up,
    "turns": lambda r: Rotating(r.uniform(0.5, 3)),
    "many turns": lambda r: Rotating(r.uniform(4, 8)),
    "smooth flow": lambda r: Gaussian(0.7, r.uniform(0.2, 1.0)),
    "straight flow": lambda r: Straight(0.7, r.uniform(0.1, 1.0)),
    "narrow flow": lambda r: Gaussian(0.0, 10 ** r.uniform(-3, -2)),
    "two modes": lambda r: TwoModes(r.uniform(0.3, 1.0), r.uniform(0.03, 0.1)),
    "three modes": lambda r: GaussianMixture((0.2, 0.3, 0.5), (-1, 0.1, 0.8), (0.1, 0.05, r.uniform(0.02, 0.2))),
    "ray-drop": lambda r: RayDrop(r.uniform(0.1, 0.5)),
    "anisotropic": lambda r: Anisotropic(),
    "point": lambda r: PointMass(r.uniform(-1, 1)),
    "jet": lambda r: NarrowJet(2e-3, r.uniform(0.2, 0.8)),
    **{f"stiff {rate:g}": lambda r, k=rate: StiffLinear(k) for rate in (10.0, 1e2, 1e3, 3e4)},
    "stiff, two rates": lambda r: _stack((1.0, 10 ** r.uniform(2, 4))),
}


# Their ends hold for starts within +-2 only.
BOUNDED = ("wall in x", "kink in x", "blow-up", "logistic")
NARROW = ("box 0.05", "hump 0.05", "0.01", "jet")  # pulses narrower than 0.16 of the interval


class Count(NamedTuple):
    cases: int
    silent: int
    flagged: int
    worst: float
    evaluations: float


def run(kind: str, method: str, tolerance: float, max_step: float, seed: int = 0) -> Count:
    rng = np.random.default_rng([seed, sum(map(ord, kind))])
    problems = Mixed([KINDS[kind](rng) for _ in range(SCENES)])
    x_0 = torch.from_numpy(rng.standard_normal((SCENES, ELEMENTS)))
    if kind in BOUNDED:
        x_0 = x_0.clamp(-2, 2)
    exact = problems.solution(x_0, 1.0)
    found = solve(problems, x_0, method=method, tolerance=tolerance, max_step=max_step)
    rms = (found.x - exact).square().mean(1).sqrt() / (1 + exact.square().mean(1).sqrt()) / tolerance
    flagged = found.stiff | ~found.converged
    silent = ~flagged & ~(rms <= FAILS_AT)
    worst = float(rms[~flagged].max()) if (~flagged).any() else 0.0
    return Count(SCENES, int(silent.sum()), int(flagged.sum()), worst, float(found.evaluations.double().sum()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--max-step", type=float, default=1.0)
    parser.add_argument("--only", default="", help="kinds with this in their name")
    parser.add_argument("--methods", nargs="+", default=METHODS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'kind':26s}" + "".join(f"{m:>8s} silent of   worst  evals" for m in options.methods))
    total = {(m, narrow): [0, 0, 0, 0.0] for m in options.methods for narrow in (False, True)}
    for kind in KINDS:
        if options.only not in kind:
            continue
        line = f"{kind:26s}"
        for method in options.methods:
            counts = [run(kind, method, tolerance, options.max_step) for tolerance in TOLERANCES]
            cases, silent, flagged = (sum(getattr(c, n) for c in counts) for n in ("cases", "silent", "flagged"))
            evaluations = sum(c.evaluations for c in counts)
            line += f"{silent:10d} {cases:6d} {max(c.worst for c in counts):9.1f} {evaluations:8.0f} f{flagged:<3d}"
            group = total[method, any(word in kind for word in NARROW)]
            for place, value in enumerate((cases, silent, flagged, evaluations)):
                group[place] += value
        print(line, flush=True)
    for (method, narrow), (cases, silent, flagged, evaluations) in total.items():
        width = "pulses below the stated width" if narrow else "all others"
        print(f"{method}, {width}: {silent} of {cases} silent, {flagged} flagged, {evaluations:.0f} evaluations")


if __name__ == "__main__":
    main()
