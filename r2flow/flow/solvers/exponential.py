"""Exponential Rosenbrock method for stiff scenes.

pexprb43: Luan, Ostermann, Parallel exponential Rosenbrock methods, 2016, order 4 with an estimate of order 3. The
Jacobian J of (t, x) -> (1, v) is never formed: functions of J are computed in Krylov spaces by Arnoldi's method (Saad,
Analysis of some Krylov subspace approximations to the matrix exponential operator, 1992), and products of J with
vectors are finite differences of v, one evaluation each. Scenes are solved one after another, each with its own steps.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import check
from r2flow.flow.solvers.adaptive import attainable
from r2flow.flow.solvers.batched import norms, powered, unpowered
from r2flow.flow.solvers.solution import Evaluations, Limits, Solution, Spent

LARGEST = 40  # dimension of a Krylov space; if that is not enough, the step is halved
KRYLOV = 0.05  # error of a function of J, in tolerances
SAFETY, SHRINK, GROW = 0.8, 0.2, 8.0


class ExponentialMethod:
    adapts: ClassVar[bool] = True  # whether step sizes follow from a tolerance

    def solve(self, v: Evaluations, x: Tensor, times: Tensor, limits: Limits) -> Solution:
        """Solve every scene of x, (B, ...), from t_0 to t_1, one after another."""
        ends = x.clone()
        for place in range(len(x)):
            v.only(np.array([place]))
            scene = _Scene(v, x[place], float(times[0]), float(times[-1]), limits)
            v.converged[place] = scene.solve()
            ends[place] = scene.u.view(x.shape[1:])
        return v.solution(ends)


class _Scene:
    """State of one scene; vectors are (n + 1,), the elements of x followed by t."""

    def __init__(self, v: Evaluations, x: Tensor, t_0: float, t_1: float, limits: Limits) -> None:
        self.v, self.shape, self.limits = v, x.shape, limits
        self.u, self.t = x.flatten(), t_0
        self.direction = math.copysign(1.0, t_1 - t_0)
        self.length, self.t_0, self.t_end = abs(t_1 - t_0), t_0, t_1
        kind = x.device.type
        lower = torch.get_autocast_dtype(kind)
        self._of_network, self._of_steps = (
            torch.autocast(kind, lower, enabled=on) for on in (torch.is_autocast_enabled(kind), False)
        )

    def solve(self) -> bool:
        """Solve to t_end; whether it was reached."""
        with self._of_steps:  # full precision for the solver, independent of the network's
            try:
                f = self.velocity(self.t, self.u)
                lost = torch.is_grad_enabled() and (f.requires_grad or self.u.requires_grad)
                check(not lost, "exponential steps have no gradient: solve with dopri5 or under torch.no_grad().")
                return self._solve(f)
            except Spent:
                return False

    @torch.no_grad()
    def _solve(self, f: Tensor) -> bool:
        self.tolerance = attainable(self.limits, self.v.precision)
        self.roundoff = torch.finfo(self.v.precision).eps
        # Differences of a noisy velocity (dropout, sampling inside the network) do not approximate J.
        if _rms(self.velocity(self.t, self.u) - f) > math.sqrt(self.roundoff) * _rms(f):
            return False
        # The first step as in explicit methods, but not limited by the rate of change of x, which J covers.
        slope = _rms(f / (self.tolerance * (1 + self.u.abs())))
        h = min((0.01 / slope) ** 0.25, self.length) if slope > 0 else self.length
        while self.t != self.t_end and f.isfinite().all():
            krylov = _Krylov(partial(self.product, f), torch.cat([f, f.new_ones(1)]))
            left = abs(self.t_end - self.t)
            while True:
                h = min(h, self.limits.max_step * self.length)
                h = left if 1.01 * h >= left else left / 2 if 2 * h > left else h
                if h < self._shortest():
                    return False
                error, h, end, following = self._try(f, krylov, h)
                factor = min(max(SAFETY * max(error, 1e-10) ** -0.25, SHRINK), GROW) if error < math.inf else SHRINK
                if error <= 1:
                    break
                self.v.rejected[self.v.scenes] += 1
                h *= min(factor, 0.8)
            self.v.accepted[self.v.scenes] += 1
            self.t = self.t_end if h == left else self.t + self.direction * h
            self.u, f, h = end, following, h * factor
        return self.t == self.t_end

    def velocity(self, t: float, u: Tensor) -> Tensor:
        """v(t, u) as a vector."""
        low, high = sorted((self.t_0, self.t_end))
        with self._of_network:
            time = u.new_full((1,), min(max(t, low), high))
            return self.v.of_one(time, u.view(1, *self.shape), self.limits).flatten()

    def product(self, f: Tensor, direction: Tensor) -> Tensor:
        """J times a vector, by a difference of v forward in time, so that v is not evaluated outside the interval."""
        ahead = float(direction[-1]) * self.direction
        scale = (1 + _rms(self.u)) * math.sqrt(len(self.u))
        length = math.hypot(float(torch.linalg.vector_norm(direction[:-1])) / scale, ahead)
        if not length:
            return torch.zeros_like(direction)
        step = math.sqrt(self.roundoff) / length
        step = math.copysign(min(step, abs(self.t_end - self.t) / max(abs(ahead), 1e-300)), ahead)
        moved = self.velocity(self.t + step * float(direction[-1]), self.u + step * direction[:-1])
        return torch.cat([(moved - f) / step, f.new_zeros(1)])

    def _shortest(self) -> float:
        return 4 * torch.finfo(self.u.dtype).eps * max(abs(self.t), 1e-3 * self.length)

    def _try(self, f: Tensor, krylov: "_Krylov", h: float) -> tuple[float, float, Tensor, Tensor]:
        """Try a step: its error in tolerances, its length (at most h), its end and the velocity there.

        The estimate, 12 R(1) - 48 R(1/2), vanishes for any R = c h^2: the remainder at the end must be R(1), too.
        """
        scale = self.tolerance * (1 + self.u.abs())
        while not krylov.enough(1, self.direction * h, scale):
            h /= 2
            if not krylov.finite or h < self._shortest():
                return math.inf, h, self.u, f
        signed = self.direction * h
        combinations = [krylov.combination(1, share * signed) for share in (0.5, 1.0)]
        remainders = []
        for share, y in zip((0.5, 1.0), combinations, strict=True):
            offset, linear = krylov.vector(y)[:-1], krylov.image(y)[:-1]
            v_moved = self.velocity(self.t + share * signed, self.u + share * signed * offset)
            remainders.append(v_moved - f - share * signed * linear)
        linear = end = self.u + signed * krylov.vector(combinations[1])[:-1]
        part, following = torch.zeros_like(end), v_moved
        for order, start in ((3, 16 * remainders[0] - 2 * remainders[1]), (4, 12 * remainders[1] - 48 * remainders[0])):
            part = self._filtered(f, order, start, signed, scale)
            end = end + part
        scale = self.tolerance * (1 + torch.maximum(self.u.abs(), end.abs()))
        error = _error(part / scale)
        if error <= 1 and not torch.equal(end, linear):
            following = self.velocity(self.t + signed, end)
            along = self.product(f, torch.cat([end - self.u, end.new_full((1,), signed)]))[:-1]
            missed = self._filtered(f, 3, following - f - along - remainders[1], signed, scale)
            error = max(error, _error(missed / scale))
        return (error if torch.stack([end, following]).isfinite().all() else math.inf), h, end, following

    def _filtered(self, f: Tensor, order: int, start: Tensor, h: float, scale: Tensor) -> Tensor:
        """h phi_order(h J) times a vector: 0 if it is negligible, NaN if the Krylov space is too small."""
        if abs(h) * _rms(start / scale) <= KRYLOV:
            return torch.zeros_like(start)
        space = _Krylov(partial(self.product, f), torch.cat([start, start.new_zeros(1)]))
        if not (start.isfinite().all() and space.enough(order, h, scale)):
            return torch.full_like(start, math.nan)
        return h * space.vector(space.combination(order, h))[:-1]


class _Krylov:
    """Krylov space of b, J b, J^2 b, ..., with orthonormal basis V and J V_m = V_(m+1) H."""

    def __init__(self, product: Callable[[Tensor], Tensor], start: Tensor) -> None:
        self._product, self.size = product, float(torch.linalg.vector_norm(start.double()))
        self.basis = start.new_empty(LARGEST + 1, len(start))
        self.basis[0] = start / self.size
        self.matrix = np.zeros((LARGEST + 1, LARGEST))
        self.m = 0

    def enough(self, order: int, h: float, scale: Tensor) -> bool:
        """Extend the space until h phi_order(h J) b has an error of `KRYLOV` tolerances; False if `LARGEST` is reached.

        The error is about |b| h_(m+1,m) |h^2 phi_(order+1)(h H)_(m,1)| along the next vector (Saad).
        """
        while True:
            if self.m:
                beyond = self.matrix[self.m, self.m - 1]
                tail = abs(self._phi(order + 1, h)[-1]) * h**2 * beyond * self.size
                if tail == 0 or tail * _rms(self.basis[self.m][:-1] / scale) <= KRYLOV:
                    return True
            if self.m == LARGEST or not self.finite:
                return False
            self._extend()

    @property
    def finite(self) -> bool:
        """Whether all products with J are finite."""
        return bool(np.isfinite(self.matrix).all())

    def _extend(self) -> None:
        m = self.m
        following, basis = self._product(self.basis[m]), self.basis[: m + 1]
        for _ in range(2):  # twice, against rounding errors
            along = basis @ following
            following = following - along @ basis
            self.matrix[: m + 1, m] += along.double().cpu().numpy()
        beyond = float(torch.linalg.vector_norm(following))
        self.matrix[m + 1, m] = beyond
        self.basis[m + 1] = following / beyond if beyond > 0 else following
        self.m += 1

    def _phi(self, order: int, h: float) -> np.ndarray:
        """phi_order(h H) e_1 by the exponential of an augmented matrix (Al-Mohy, Higham, 2011)."""
        m = self.m
        augmented = np.zeros((m + order, m + order))
        augmented[:m, :m] = h * self.matrix[:m, :m]
        augmented[0, m] = 1
        augmented[m:-1, m + 1 :] = np.eye(order - 1)
        return torch.linalg.matrix_exp(torch.from_numpy(augmented))[:m, -1].numpy()

    def combination(self, order: int, h: float) -> np.ndarray:
        """phi_order(h J) b in the basis."""
        return self.size * self._phi(order, h)

    def vector(self, y: np.ndarray) -> Tensor:
        """V y."""
        return torch.from_numpy(y).to(self.basis) @ self.basis[: len(y)]

    def image(self, y: np.ndarray) -> Tensor:
        """J V y."""
        return self.vector(self.matrix[: self.m + 1, : self.m] @ y)


def _error(x: Tensor) -> float:
    """The norm of an error in tolerances, as in explicit methods; infinite if it is not finite."""
    size = float(unpowered(norms(powered(x)[None]))[0, 0])
    return size if math.isfinite(size) else math.inf


def _rms(x: Tensor) -> float:
    return float(norms(x[None])[0, 0])
