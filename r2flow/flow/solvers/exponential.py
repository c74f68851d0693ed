"""Exponential Rosenbrock method for stiff scenes.

pexprb43: Luan, Ostermann, Parallel exponential Rosenbrock methods, 2016, order 4 with an estimate
of order 3. The Jacobian J of (s, x) -> (1, dx/ds) is never formed: functions of J are computed in
Krylov spaces by Arnoldi's method (Saad, Analysis of some Krylov subspace approximations to the
matrix exponential operator, 1992), and products of J with vectors are finite differences of v, one
evaluation each. Scenes are solved one after another, each with its own steps.
"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.flow.solvers.adaptive import attainable
from r2flow.flow.solvers.batched import norms, powered, unpowered
from r2flow.flow.solvers.solution import Evaluations, Solution, Spent

_LARGEST = 40  # dimension of a Krylov space; if that is not enough, the step is halved
_KRYLOV = 0.05  # error of a function of J, in tolerances
_SAFETY = 0.8
_SHRINK = 0.2
_GROW = 8.0


class ExponentialMethod:
    """pexprb43, for scenes without a gradient."""

    adapts = True  # whether step sizes follow from a tolerance

    @np.errstate(all="ignore")
    def solve(self, v: Evaluations, x: Tensor, times: Tensor) -> Solution:
        """Solve every scene of x, (B, ...), from the first time to the last, one after another."""
        ends = []
        for place, start in enumerate(x):
            v.only(np.array([place]))
            scene = _Scene(v, start, *times.tolist())
            v.converged[place] = scene.solve()
            ends.append(scene.u.view(start.shape))
        return v.solution(torch.stack(ends))


class _Scene:
    """State u of one scene at a length s from t_0; vectors are (n + 1,), those of (x, s)."""

    def __init__(self, v: Evaluations, x: Tensor, t_0: float, t_1: float) -> None:
        self.v = v
        self.shape = x.shape
        self.u = x.flatten()
        self.s = 0.0
        self.t_0 = t_0
        self.t_1 = t_1
        self.length = abs(t_1 - t_0)

    def solve(self) -> bool:
        """Solve to t_1; whether it was reached."""
        try:
            f = self.slope(0.0, self.u)
            if torch.is_grad_enabled() and (f.requires_grad or self.u.requires_grad):
                raise InputError(
                    "exponential steps have no gradient: solve with dopri5 or under "
                    "torch.no_grad()."
                )
            return self._solve(f)
        except Spent:
            return False

    @torch.no_grad()
    def _solve(self, f: Tensor) -> bool:
        self.tolerance = attainable(self.v.limits, self.v.precision)
        self.difference = math.sqrt(torch.finfo(self.v.precision).eps)
        # Differences of a noisy velocity (dropout, sampling in the network) do not approximate J.
        if _rms(self.slope(0.0, self.u) - f) > self.difference * _rms(f):
            return False
        # The first step as in explicit methods, but not limited by the change of x: J covers it.
        speed = _rms(f / self._scale(self.u))
        h = (0.01 / speed) ** 0.25 if speed > 0 else self.length
        while self.s < self.length and f.isfinite().all():
            krylov = self._space(f, f, 1.0)
            left = self.length - self.s
            error = math.inf
            while error > 1:
                h = min(h, self.v.limits.max_step * self.length)
                if 1.01 * h >= left:
                    h = left
                elif 2 * h > left:
                    h = left / 2
                if h < self._shortest():
                    return False
                error, h, end, following = self._try(f, krylov, h)
                tried = h
                self.v.rejected[self.v.scenes] += error > 1
                factor = min(max(_SAFETY * max(error, 1e-10) ** -0.25, _SHRINK), _GROW)
                h *= factor if error <= 1 else min(factor, 0.8)
            self.v.accepted[self.v.scenes] += 1
            self.s = self.length if tried == left else self.s + tried
            self.u = end
            f = following
        return self.s == self.length

    def slope(self, s: float, u: Tensor) -> Tensor:
        """du / ds at a length s from t_0, at most to t_1."""
        t = u.new_full((1,), self._time(s))
        v = self.v.of_one(t, u.view(1, *self.shape)).flatten()
        return v if self.t_1 > self.t_0 else -v

    def _time(self, s: float) -> float:
        share = s / self.length
        return self.t_1 if share >= 1 else self.t_0 + (self.t_1 - self.t_0) * share

    def product(self, f: Tensor, direction: Tensor) -> Tensor:
        """J times a vector, by a difference forward in s, which stays in the interval."""
        moved = direction[:-1]
        later = float(direction[-1])
        scale = (1 + _rms(self.u)) * math.sqrt(len(self.u))
        size = math.hypot(float(torch.linalg.vector_norm(moved)) / scale, later)
        if not size:
            return torch.zeros_like(direction)
        most = (self.length - self.s) / max(abs(later), 1e-300)
        step = math.copysign(min(self.difference / size, most), later)
        ahead = self.slope(self.s + step * later, self.u + step * moved)
        return _joined((ahead - f) / step, 0.0)

    def _space(self, f: Tensor, x: Tensor, s: float) -> "_Krylov":
        return _Krylov(partial(self.product, f), _joined(x, s))

    def _scale(self, u: Tensor) -> Tensor:
        return self.tolerance * (1 + u.abs())

    def _shortest(self) -> float:
        t = max(abs(self._time(self.s)), 1e-3 * self.length)
        return 4 * torch.finfo(self.u.dtype).eps * t

    def _try(self, f: Tensor, krylov: "_Krylov", h: float) -> tuple[float, float, Tensor, Tensor]:
        """Try a step: its error in tolerances, its length (at most h), its end and the slope there.

        The estimate, 12 R(1) - 48 R(1/2), vanishes for any R = c h^2: the remainder at the end must
        be R(1), too.
        """
        scale = self._scale(self.u)
        while not krylov.enough(1, h, scale):
            h /= 2
            if not krylov.finite or h < self._shortest():
                return math.inf, h, self.u, f
        half, _, _ = self._remainder(f, krylov, h / 2)
        whole, linear, following = self._remainder(f, krylov, h)
        third = self._filtered(f, 3, 16 * half - 2 * whole, h, scale)
        fourth = self._filtered(f, 4, 12 * whole - 48 * half, h, scale)
        end = linear + third + fourth
        scale = torch.maximum(scale, self._scale(end))
        error = _error(fourth / scale)
        if error <= 1 and not torch.equal(end, linear):
            following = self.slope(self.s + h, end)
            along = self.product(f, _joined(end - self.u, h))[:-1]
            missed = self._filtered(f, 3, following - f - along - whole, h, scale)
            error = max(error, _error(missed / scale))
        if not (end + following).isfinite().all():
            error = math.inf
        return error, h, end, following

    def _remainder(self, f: Tensor, krylov: "_Krylov", h: float) -> tuple[Tensor, Tensor, Tensor]:
        """R(h) = f' - f - J (u' - u), the linear solution u' after h, and the slope f' there."""
        y = krylov.combination(1, h)
        end = self.u + h * krylov.vector(y)[:-1]
        following = self.slope(self.s + h, end)
        return following - f - h * krylov.image(y)[:-1], end, following

    def _filtered(self, f: Tensor, order: int, start: Tensor, h: float, scale: Tensor) -> Tensor:
        """h phi_order(h J) times a vector: 0 if negligible, NaN if the space is too small."""
        if h * _rms(start / scale) <= _KRYLOV:
            return torch.zeros_like(start)
        space = self._space(f, start, 0.0)
        if not space.enough(order, h, scale):
            return torch.full_like(start, math.nan)
        return h * space.vector(space.combination(order, h))[:-1]


class _Krylov:
    """Krylov space of b, J b, J^2 b, ..., with orthonormal basis V and J V_m = V_(m+1) H.

    Products with V are sums: autocast, which may surround the solver, would round a matrix product.
    """

    def __init__(self, product: Callable[[Tensor], Tensor], start: Tensor) -> None:
        self._product = product
        self.size = float(torch.linalg.vector_norm(start.double()))
        self.basis = start.new_empty(_LARGEST + 1, len(start))
        self.basis[0] = start / self.size
        self.matrix = np.zeros((_LARGEST + 1, _LARGEST))
        self.m = 0

    @property
    def finite(self) -> bool:
        """Whether b and all products with J are finite."""
        return bool(np.isfinite(self.matrix.sum() + self.size))

    def enough(self, order: int, h: float, scale: Tensor) -> bool:
        """Extend the space until the error of h phi_order(h J) b is `_KRYLOV`; False if it stays.

        The error is about |b| h_(m+1,m) |h^2 phi_(order+1)(h H)_(m,1)| along the next vector
        (Saad).
        """
        while self.finite:
            if self.m:
                beyond = self.matrix[self.m, self.m - 1] * self.size
                tail = abs(self._phi(order + 1, h)[-1]) * h**2 * beyond
                if tail == 0 or tail * _rms(self.basis[self.m, :-1] / scale) <= _KRYLOV:
                    return True
            if self.m == _LARGEST:
                return False
            self._extend()
        return False

    def _extend(self) -> None:
        m = self.m
        following = self._product(self.basis[m])
        basis = self.basis[: m + 1]
        for _ in range(2):  # twice, against rounding errors
            along = (basis * following).sum(1)
            following = following - (along[:, None] * basis).sum(0)
            self.matrix[: m + 1, m] += along.cpu().numpy()
        beyond = float(torch.linalg.vector_norm(following))
        self.matrix[m + 1, m] = beyond
        self.basis[m + 1] = following / beyond if beyond > 0 else following
        self.m += 1

    def _phi(self, order: int, h: float) -> ndarray:
        """phi_order(h H) e_1 by the exponential of an augmented matrix (Al-Mohy, Higham, 2011)."""
        m = self.m
        augmented = np.eye(m + order, k=1)
        augmented[:m] = 0
        augmented[:m, :m] = h * self.matrix[:m, :m]
        augmented[0, m] = 1
        return torch.linalg.matrix_exp(torch.from_numpy(augmented))[:m, -1].numpy()

    def combination(self, order: int, h: float) -> ndarray:
        """phi_order(h J) b in the basis."""
        return self.size * self._phi(order, h)

    def vector(self, y: ndarray) -> Tensor:
        return (self.basis.new_tensor(y)[:, None] * self.basis[: len(y)]).sum(0)

    def image(self, y: ndarray) -> Tensor:
        return self.vector(self.matrix[: len(y) + 1, : len(y)] @ y)


def _joined(x: Tensor, s: float) -> Tensor:
    """The vector (x, s)."""
    return torch.cat([x, x.new_full((1,), s)])


def _error(x: Tensor) -> float:
    """The norm of an error in tolerances, as in explicit methods; infinite if it is not finite."""
    size = float(unpowered(norms(powered(x)[None]))[0, 0])
    return size if math.isfinite(size) else math.inf


def _rms(x: Tensor) -> float:
    return float(norms(x[None])[0, 0])
