"""Answers of a transfer flow: a density for every ray, and normal numbers to draw from it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from r2flow.generators.calibration import Calibration

NEVER = -1e4  # logit of a missing candidate
# Correlation length of drawn answers: best panel on scans of KITTI raw and object.
TOGETHER = math.radians(1.5)
_HIT = 0.1  # metres
# Widths of an interval about a completed range, over its expected error, between which
# probabilities are interpolated: on scans they are then wrong by 1 % in the mean.
_WIDTHS = (1 / 32, 1 / 8, 1 / 3, 1.0, 2.5)
_WIDEST = 5.0  # largest width: nothing is known of such a ray
RAYS = 8192  # of a block: what is computed of them stays in a core's cache
FAINT = 0.1  # reflectance of training, below which differences are as errors, not as ratios


@dataclass(frozen=True)
class Answers:
    """The network's prediction for every ray: p(x_1 | x_t, condition), a mixture of candidates."""

    logits: Tensor  # log probability of each candidate, given a return, (B, 7, H, W)
    ranges: Tensor  # log r of each candidate, (B, 7, H, W); the last is predicted freely
    scales: Tensor  # scale b of each candidate's Laplace density on log r, (B, 7, H, W)
    returns: Tensor  # logit of a return, (B, 1, H, W)
    strengths: Tensor  # reflectance of each candidate, (B, 7, H, W)
    labels: Tensor  # log probability of each class, given a return, (B, K, H, W); K = 0 without
    faint: Tensor | float = FAINT  # `FAINT` in the scan's own units
    calibration: Calibration | None = None  # of `error`, `p_return` and `calibrated`

    def among(self, rows: int, own: slice) -> "Answers":
        """These rows among `rows` rows, of which the others have no return."""
        sides = (0, 0, own.start, rows - own.stop)
        if not any(sides):
            return self
        ranges, scales, logits, strengths, labels = (
            F.pad(value, sides, value=1.0)
            for value in (self.ranges, self.scales, self.logits, self.strengths, self.labels)
        )
        returns = F.pad(self.returns, sides, value=NEVER)
        return replace(
            self,
            logits=logits,
            ranges=ranges,
            scales=scales,
            returns=returns,
            strengths=strengths,
            labels=labels,
        )

    def of(self, rays: Tensor) -> "Answers":
        """Those of some rays, (1, C, 1, N), by their places in the flat images, (N,)."""
        images = self.returns.shape

        def some(values: Any) -> Any:
            if not isinstance(values, Tensor):
                return values
            flat = values.expand(-1, -1, *images[2:]).movedim(1, 0).flatten(1)
            return flat.index_select(1, rays)[None, :, None]

        return Answers(*map(some, vars(self).values()))

    def log_density(self, log_r: Tensor) -> Tensor:
        """log p(log r | return), (B, 1, H, W)."""
        return self._log_densities(log_r).logsumexp(1, keepdim=True)

    def strength(self) -> Tensor:
        """Reflectance, (B, 1, H, W): the mean of log(s + faint) over candidates, weights sqrt(p).

        A retroreflector hardly brightens what is next to it. Neighbours agree in reflectance over
        more than an edge in range, so the likeliest candidate counts less than for range.
        """
        weights = (self.logits / 2).softmax(1)
        mean = ((self.strengths + self.faint).log() * weights).sum(1, keepdim=True)
        return mean.exp() - self.faint

    def hits(self, log_r: Tensor) -> Tensor:
        """Probability, given a return, that r is within `_HIT` of a range, (B, 1, H, W)."""
        return (2 * _HIT * (self.log_density(log_r) - log_r).exp()).clamp(max=1)

    def likeliest(self, log_r: Tensor) -> Tensor:
        """Index of the candidate most likely to have produced log r, (B, 1, H, W)."""
        return self._log_densities(log_r).argmax(1, keepdim=True)

    def _log_densities(self, log_r: Tensor) -> Tensor:
        return self.logits - (2 * self.scales).log() - ((log_r - self.ranges).abs() / self.scales)

    def quantile(self, u: Tensor) -> Tensor:
        """Quantile of log r given a return, at u in (0, 1), (B, 1, H, W), by bisection."""
        p = self.logits.exp()
        low = (self.ranges - 20 * self.scales).amin(1, True)
        high = (self.ranges + 20 * self.scales).amax(1, True)
        for _ in range(28):
            middle = (low + high) / 2
            z = (middle - self.ranges) / self.scales
            shares = p * torch.where(z < 0, z.exp() / 2, 1 - (-z).exp() / 2)
            below = shares.sum(1, keepdim=True) < u
            low = torch.where(below, middle, low)
            high = torch.where(below, high, middle)
        return (low + high) / 2

    @property
    def p_return(self) -> Tensor:
        """Probability of a return, calibrated, (B, 1, H, W); 1 or 0 for measured rays."""
        if self.calibration is None:
            return self.returns.sigmoid()
        slope, offset = self.calibration.returns
        return (slope * self.returns + offset).sigmoid()

    def calibrated(self) -> "Answers":
        """These answers with the calibrated density, for drawing: its last candidate is wide, and
        has the reflectance of the likeliest one.
        """
        if self.calibration is None or self.calibration.spread is None:
            return self
        parts = (x.movedim(1, 0).flatten(1) for x in (self.logits, self.ranges, self.scales))
        likely = self.logits.argmax(1, keepdim=True)
        strengths = torch.cat([self.strengths, self.strengths.gather(1, likely)], 1)
        shape = strengths.movedim(1, 0).shape
        widened = (x.view(shape).movedim(0, 1) for x in self.calibration.widen(*parts))
        logits, ranges, scales = widened
        return replace(
            self,
            logits=logits,
            ranges=ranges,
            scales=scales,
            strengths=strengths,
            returns=self.p_return.logit(1e-6),
            calibration=None,
        )

    def error(self, r: Tensor, levels: Sequence[float]) -> Tensor:
        """Metres e with P(|x - r| <= e | return) = level for ranges r, (levels, B, H, W).

        r is (B, 1, H, W); 0 where r is 0 and for measured rays. Rays are independent of each other:
        e is the half width of the interval log r +- w, of which P is known at some w (`_WIDTHS`),
        interpolated linearly in log w and log(-log(1 - P)), which is exact for one Laplace density.
        """
        asked = ((r > 0) & (self.returns.abs() < -NEVER / 2)).flatten().nonzero()[:, 0]
        errors = r.new_zeros(len(levels), r.numel())
        wanted = [math.log(-math.log1p(-level)) for level in levels]
        density = [x.movedim(1, 0).flatten(1) for x in (self.logits, self.ranges, self.scales)]
        for rays in (asked,) if torch.compiler.is_exporting() else asked.split(RAYS):
            metres = r.flatten()[rays]
            logits, ranges, scales = (x.index_select(1, rays) for x in density)
            if self.calibration is not None:
                logits, ranges, scales = self.calibration.widen(logits, ranges, scales)
            widths = _widths(logits.exp(), (ranges - metres.log()).abs(), scales, wanted)
            errors[:, rays] = metres * widths
        if self.calibration is not None:
            errors *= errors.new_tensor([*map(self.calibration.factor, levels)])[:, None]
        return errors.view(len(levels), len(r), *r.shape[2:])

    def least_error(self) -> Tensor:
        """Index k of the candidate with the smallest expected |log r - m_k|, (B, 1, H, W).

        E|m - X| = |m - m_j| + b_j exp(-|m - m_j| / b_j) for X from the Laplace density of j.
        """
        p = self.logits.exp()
        least = torch.full_like(self.returns, torch.inf)
        best = torch.zeros_like(self.returns, dtype=torch.int64)
        for k, own in enumerate(self.ranges.split(1, 1)):
            distance = (own - self.ranges).abs()
            spread = self.scales * (-distance / self.scales).exp()
            error = (p * (distance + spread)).sum(1, keepdim=True)
            better = (error < least) & (self.logits[:, k : k + 1] > NEVER / 2)
            least = torch.where(better, error, least)
            best = torch.where(better, k, best)
        return best


def _widths(p: Tensor, away: Tensor, scales: Tensor, wanted: Sequence[float]) -> Tensor:
    """Half widths w with log(-log(1 - P(|log x - log r| <= w))) as wanted, (levels, N).

    The candidates, (K, N), have probabilities p and are at distances `away` from log r.
    """
    inverse = 1 / scales
    mean = (p * (away + scales * (-away * inverse).exp())).sum(0)
    y = []
    for factor in _WIDTHS:
        width = factor * mean
        z = (width - away) * inverse
        near = z.abs().neg().exp()
        twice = torch.where(z < 0, near, 2 - near) - ((width + away) * inverse).neg().exp()
        inside = (p * twice).sum(0) / 2
        y.append((-torch.log1p(-inside.clamp(1e-6, 1 - 1e-6))).log())
    found = []
    x = [math.log(factor) for factor in _WIDTHS]
    for level in wanted:
        log_w = torch.full_like(mean, -torch.inf)
        for k in range(len(x) - 1):
            slope = (x[k + 1] - x[k]) / (y[k + 1] - y[k]).clamp(min=0.05)
            at = x[k] + slope * (level - y[k])
            log_w = at if k == 0 else torch.where(y[k] <= level, at, log_w)
        most = math.exp(math.exp(level))  # 1 / (1 - P), by Markov's inequality
        found.append((mean * log_w.exp().clamp(max=most)).clamp(max=_WIDEST))
    return torch.stack(found)


def smoothed(e: Tensor, hidden: Tensor, elevations: Tensor) -> Tensor:
    """Standard normal numbers of hidden rays, (B, 1, H, W), correlated over `TOGETHER`.

    z = sum_k w_k e_k / sqrt(sum_k w_k^2) over hidden rays k, with e_k independent and
    w_k = exp(-d^2 / 2) for d the angle over `TOGETHER`, in both angles. Other rays get no
    meaningful number. Elevations are those of the rows in radians, (H,).
    """
    rows, columns = e.shape[2:]
    down = _weights(abs(float(elevations[0] - elevations[-1])) / max(rows - 1, 1), e.device)
    along = _weights(2 * math.pi / columns, e.device)
    variance = _convolved(hidden.double(), down**2, along**2)
    return (_convolved(e.double() * hidden, down, along) / variance.clamp(min=1e-12).sqrt()).to(e)


def _weights(step: float, device: torch.device) -> Tensor:
    """w_k of `smoothed` for rays at an angle of `step`; float64: no autocast or TF32 rounds it."""
    reach = int(3 * TOGETHER / max(step, 1e-3)) + 1
    number = torch.arange(-reach, reach + 1, dtype=torch.float64, device=device)
    return torch.exp(-0.5 * (number * step / TOGETHER) ** 2)


def _convolved(x: Tensor, down: Tensor, along: Tensor) -> Tensor:
    x = F.conv2d(x, down[None, None, :, None], padding=(len(down) // 2, 0))
    side = len(along) // 2
    return F.conv2d(F.pad(x, (side, side, 0, 0), "circular"), along[None, None, None])
