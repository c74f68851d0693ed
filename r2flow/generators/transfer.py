"""A rectified flow from a repaired scan to the scan: x_0 is no noise, but what the known rays say of the others."""

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from r2flow.backbones import build_backbone
from r2flow.errors import InputError
from r2flow.flow.maps import MeanVelocity
from r2flow.flow.path import expand_time
from r2flow.generators.base import IMAGE, KNOWN, Condition, Generated, parts_of
from r2flow.generators.flow import Conditioned, Flow
from r2flow.generators.surroundings import FEATURES, RowFeatures, Surroundings, encoded, steps_of
from r2flow.lidar.space import ModelSpace
from r2flow.registry import NonNegative
from r2flow.samplers import Jump

LAST = 1e-5  # of the time: where the velocity stops to grow
CANDIDATES = 7  # six of `Surroundings` and the network's own
BISECTIONS = 28
FINEST = 1e-3  # of a range: no return is known better
FREE, SHIFT = 0.3, 0.02  # how far the answer nought moves a free range, and one of a neighbour, on log r
NEVER = -1e4  # logit of what there is not
WEIGHTS = {"range": 1.0, "return": 2.0, "reflectance": 4.0}  # of the three parts of the loss


@dataclass(frozen=True)
class Answers:
    """What the network says of every ray: p(x_1 | x_t, what is known).

    Attributes:
        logits: Log probability of each candidate, given that the ray returns, (B, 7, H, W).
        ranges: Its log r, (B, 7, H, W); the last candidate is the network's own.
        scales: b of its Laplace density on log r, (B, 7, H, W).
        returns: Logit of a return, (B, 1, H, W).
        strengths: Reflectance with each candidate, (B, 7, H, W).
    """

    logits: Tensor
    ranges: Tensor
    scales: Tensor
    returns: Tensor
    strengths: Tensor

    def log_density(self, log_r: Tensor) -> Tensor:
        """log p(log r | return), (B, 1, H, W)."""
        each = self.logits - (2 * self.scales).log() - (log_r - self.ranges).abs() / self.scales
        return each.logsumexp(1, keepdim=True)

    def quantile(self, u: Tensor) -> Tensor:
        """The log r below which a return lies with probability u of (0, 1), (B, 1, H, W), by bisection."""
        p = self.logits.exp()
        low, high = (self.ranges - 20 * self.scales).amin(1, True), (self.ranges + 20 * self.scales).amax(1, True)
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            off = (middle - self.ranges) / self.scales
            below = (p * torch.where(off < 0, off.exp() / 2, 1 - (-off).exp() / 2)).sum(1, keepdim=True) < u
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return (low + high) / 2

    def likeliest(self, log_r: Tensor) -> Tensor:
        """The candidate that log r is most likely of, (B, 1, H, W)."""
        each = self.logits - self.scales.log() - (log_r - self.ranges).abs() / self.scales
        return each.argmax(1, keepdim=True)

    def least_error(self) -> Tensor:
        """The candidate whose expected |log r - m_k| is least, (B, 1, H, W).

        E|m - X| = |m - m_j| + b_j exp(-|m - m_j| / b_j) for X of the Laplace density of candidate j.
        """
        p, errors = self.logits.exp(), []
        for k in range(CANDIDATES):
            off = (self.ranges[:, k : k + 1] - self.ranges).abs()
            errors.append((p * (off + self.scales * (-off / self.scales).exp())).sum(1))
        missing = self.logits <= NEVER / 2
        return torch.stack(errors, 1).masked_fill(missing, torch.inf).argmin(1, keepdim=True)


class TransferFlow(Flow):
    """A rectified flow whose lines begin at a scan: x_t = (1 - t) x_0 + t x_1 with x_0 = s(x_1) + sigma e.

    s keeps the known rays and fills the others from the known returns next to them. The network learns the density of
    x_1 given x_t and what is known, ray by ray: a mixture over candidates, these neighbours among them, so that an edge
    stays an edge (variational flow matching, Eijkelboom et al. 2024). The velocity is that of its mean,

        v = (E[x_1 | x_t] - x_t) / (1 - t),

    and a step that ends at t = 1 takes the candidate of least expected error instead, or no return where that is more
    likely. So one evaluation gives the median of each ray; the sampler `transport` draws answers that differ as far as
    the scan leaves it open. Known rays come back to the bit. It takes images of any size and sensor (`at`).

    Args:
        space: The images it makes.
        backbone: Name and options of one that takes any size, as conf/backbone/local.yaml.
        sigma: Noise of x_0 in model space.
    """

    told, draws = True, False

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any], sigma: NonNegative = 0.25) -> None:
        super().__init__(space)
        self.sigma = sigma
        channels = space.shape[0]
        inputs = channels + FEATURES + RowFeatures.FEATURES
        self.backbone = build_backbone(backbone, space.rays, inputs, 3 * CANDIDATES + 2)
        if not self.backbone.any_size:
            raise InputError(
                f"a transfer flow needs a backbone for any size: give backbone=local, not {backbone['name']}."
            )
        self.rows = RowFeatures(space.rays[0, :, 0])
        self.elevations, self.numbered = space.rays[0, :, 0], True
        self.run_by(Jump(steps=1))

    def at(self, space: ModelSpace, numbered: bool = True) -> Self:
        """The same flow through another sensor, its weights shared.

        Args:
            numbered: Whether what was learned of single rows holds: rows that the trained sensor does not fill.
        """
        part = copy(self)
        part.space, part.noise_shape, part.elevations = space, space.shape, space.rays[0, :, 0]
        part.numbered = numbered
        return part

    def answers(self, t: Tensor, x: Tensor, about: Surroundings, rows: Tensor) -> Answers:
        """p(x_1 | x_t, what is known).

        Args:
            t: (B,) or ().
            x: x_t, (B, C, H, W).
            rows: Of `RowFeatures`.
        """
        shape = len(x), -1, *x.shape[2:]
        seen = torch.cat([x - about.start, about.features, rows.expand(*shape)], 1)
        said = self.backbone(t, seen).float()
        logits, shifts, scales = said[:, :-2].chunk(3, 1)
        returns, strength = said[:, -2:].split(1, 1)
        usual = said.new_tensor([0, 0, 0, 0, 2, 1, 0])[:, None, None]
        there = torch.cat([about.there, torch.ones_like(about.there[:, :1])], 1)
        logits = (logits + usual).masked_fill(~there, NEVER).log_softmax(1)
        ranges = torch.cat([about.ranges + SHIFT * shifts[:, :6], about.guess + FREE * shifts[:, 6:]], 1)
        scales = (scales - 4).clamp(max=2).exp() + FINEST
        nearest = about.strengths.gather(1, about.there.int().argmax(1, keepdim=True))
        strengths = torch.cat([about.strengths, nearest], 1) + strength
        returns = torch.where(about.sure != 0, -NEVER * about.sure, returns + 1)
        return Answers(logits, ranges, scales, returns, strengths.clamp(0, 1) if not self.training else strengths)

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        return self._toward(t, x, condition, last=False)

    def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None) -> Tensor:
        """The velocity, and to s = 1 that of the straight line to the answer."""
        return self._toward(t, x, condition, last=bool((torch.as_tensor(s) >= 1).all()))

    def map(self, condition: Condition | None = None) -> MeanVelocity:
        """u(t, x, s) under a condition."""
        return Conditioned(self, condition or {})

    def _toward(self, t: Tensor, x: Tensor, condition: Condition | None, last: bool) -> Tensor:
        assert condition is not None
        t = torch.as_tensor(t, device=x.device, dtype=torch.float32)
        answers = self._answered(t, x, condition)
        x_1 = torch.where(condition[KNOWN] > 0, condition[IMAGE], (self._chosen if last else self._mean)(answers)).to(x)
        return ((x_1 - x) / (1 - expand_time(t, x)).clamp(min=LAST)).to(x)

    def transported(self, x_0: Tensor, condition: Condition) -> Tensor:
        """x_1 by the monotone map of each ray's noise e to its density, in one evaluation: log r = F^-1(Phi(e)).

        That is the optimal transport between the two, ray by ray: of many x_0 as many returns, and ranges, as the
        network expects. Rays do not know of one another.
        """
        answers = self._answered(torch.zeros((), device=x_0.device), x_0, condition)
        u = torch.special.ndtr((x_0 - condition["start"])[:, :1].float() / max(self.sigma, 1e-6))
        p = answers.returns.sigmoid()
        log_r = answers.quantile((u / p).clamp(1e-6, 1 - 1e-6))
        strength = answers.strengths.gather(1, answers.likeliest(log_r))
        x_1 = encoded(self.space, self._within(log_r) * (u < p), strength * (u < p))
        return torch.where(condition[KNOWN] > 0, condition[IMAGE], x_1)

    def _answered(self, t: Tensor, x: Tensor, condition: Condition) -> Answers:
        about = Surroundings(*(condition[name] for name in Surroundings._fields))
        return self.answers(t, x.float(), about, condition["rows"])

    def _chosen(self, answers: Answers) -> Tensor:
        best = answers.least_error()
        r = self._within(answers.ranges.gather(1, best))
        return encoded(self.space, r * (answers.returns > 0), answers.strengths.gather(1, best) * (answers.returns > 0))

    def _mean(self, answers: Answers) -> Tensor:
        p, q = answers.logits.exp(), answers.returns.sigmoid()
        r = self._within(answers.ranges)
        each = encoded(self.space, r.flatten(0, 1)[:, None], answers.strengths.flatten(0, 1)[:, None])
        mean = (each.unflatten(0, p.shape[:2]) * p[:, :, None]).sum(1)
        nothing = encoded(self.space, torch.zeros_like(q), torch.zeros_like(q))
        return q * mean + (1 - q) * nothing

    def _within(self, log_r: Tensor) -> Tensor:
        return log_r.clamp(max=10).exp().clamp(self.space.sensor.min_range, self.space.sensor.max_range)

    @torch.no_grad()
    def forward(self, noise: Tensor, condition: Condition | None = None, **how: Any) -> Generated:
        if condition is None:
            raise InputError("a transfer flow begins at a scan: give it one, by r2flow complete.")
        weight = next(self.parameters())
        condition = {name: value.to(weight) for name, value in condition.items()}
        image, known = parts_of(condition, noise.to(weight))
        elevations = self.elevations.to(weight)[None].expand(len(image), -1)
        steps = steps_of(elevations, 2 * math.pi / image.shape[3])
        about = Surroundings.of(self.space, condition, True, steps)
        rows = self.rows(elevations, steps, steps.new_full((len(image),), self.numbered).bool())
        start = about.start + self.sigma * (known < 1) * noise.to(weight)
        made = super().forward(start, {**condition, **about._asdict(), "rows": rows}, **how)
        nothing = encoded(self.space, torch.zeros_like(image[:, :1]), torch.zeros_like(image[:, :1]))
        x = torch.where(_within_reach(known[:, :1]), made.x.to(image), nothing)
        return replace(made, x=torch.where(known > 0, image, x))

    def loss(
        self, x_1: Tensor, condition: Condition, t: Tensor, noise: Tensor, steps: Tensor, rows: Tensor
    ) -> Mapping[str, Tensor]:
        """The negative log-likelihood of the hidden rays of scans, by part: log r, return, and |reflectance|.

        Args:
            x_1: The scans, or parts of them whose columns are no full turn, (B, C, H, W).
            condition: Their `image` and `known`.
            t: Times, (B,).
            noise: (B, C, H, W).
            steps: As in `Surroundings.of`.
            rows: Of `RowFeatures`.
        """
        about = Surroundings.of(self.space, condition, ring=False, steps=steps)
        known = condition[KNOWN]
        x_0 = about.start + self.sigma * (known < 1) * noise
        at = expand_time(t, x_1)
        answers = self.answers(t, torch.where(known > 0, x_1, (1 - at) * x_0 + at * x_1), about, rows)
        metres = self.space.decode(x_1)
        returned, hidden = metres[:, :1] > 0, condition[KNOWN][:, :1] < 1
        log_r = torch.where(returned, metres[:, :1], 1.0).log()
        both = (returned & hidden).float()
        parts = {
            "range": -_mean_over(answers.log_density(log_r), both),
            "return": _mean_over(
                F.binary_cross_entropy_with_logits(answers.returns, returned.float(), reduction="none"), hidden.float()
            ),
        }
        if self.space.encoding.reflectance:
            off = (answers.strengths - metres[:, 1:2]).abs()
            parts["reflectance"] = _mean_over((answers.logits.detach().exp() * off).sum(1, keepdim=True), both)
        return parts


def _within_reach(known: Tensor) -> Tensor:
    """Rows between the measured ones and, beyond these, as far as they are apart, (B, 1, H, 1), of (B, 1, H, W)."""
    reach = []
    for rows in known[:, 0].any(2):
        measured = rows.nonzero()[:, 0]
        number = torch.arange(len(rows), device=rows.device)
        if len(measured) == 0:
            reach.append(rows)
            continue
        apart = measured.diff().max() if len(measured) > 1 else len(rows)
        reach.append((number > measured[0] - apart) & (number < measured[-1] + apart))
    return torch.stack(reach)[:, None, :, None]


def _mean_over(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp(min=1)
