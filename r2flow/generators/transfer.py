"""A rectified flow from a repaired scan to the scan: x_0 is no noise, but what the known rays say of the others."""

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones import build_backbone
from r2flow.errors import InputError
from r2flow.flow.maps import MeanVelocity
from r2flow.flow.path import expand_time
from r2flow.generators.base import IMAGE, KNOWN, Condition, Generated, parts_of
from r2flow.generators.flow import Conditioned, Flow
from r2flow.lidar.neighbours import nearest_returns
from r2flow.lidar.space import ModelSpace
from r2flow.registry import NonNegative
from r2flow.samplers import Jump

LAST = 1e-5  # of the time: where the velocity stops to grow
NEIGHBOURS, CANDIDATES = 4, 7
FEATURES = 5 * NEIGHBOURS + 11  # of `Surroundings`
ROW = 8  # numbers learned of each row
SAME = 2e-4  # radians: rows of the same elevation
BISECTIONS = 28
FINEST = 1e-3  # of a range: no return is known better
FREE, SHIFT = 0.3, 0.02  # how far the answer nought moves a free range, and one of a neighbour, on log r
NEVER = -1e4  # logit of what there is not
WEIGHTS = {"range": 1.0, "return": 2.0, "reflectance": 4.0}  # of the three parts of the loss


class Candidates(NamedTuple):
    """Values for every ray from the returns next to it.

    Attributes:
        down, aside: Rows and columns to the neighbours above, below, left and right, (B, 4, H, W); 0 without one.
        ranges: log r of these four and the values between the first and the last two, linear in 1 / r, (B, 6, H, W).
        strengths: Their reflectance, (B, 6, H, W).
        there: Which of them there are, (B, 6, H, W) bool.
        guess, usual: log r and reflectance of the best of them, (B, 1, H, W): a value between two, the upright one
            first, before a neighbour; 10 m and 0 where there is none.
    """

    down: Tensor
    aside: Tensor
    ranges: Tensor
    strengths: Tensor
    there: Tensor
    guess: Tensor
    usual: Tensor

    @classmethod
    def of(cls, log_r: Tensor, strength: Tensor, returned: Tensor, steps: Tensor, ring: bool) -> "Candidates":
        """Of images (B, 1, H, W) each; see `nearest_returns`."""
        offsets = nearest_returns(returned[:, 0], steps, ring).transpose(0, 2)  # (B, 2, 4, H, W)
        there = offsets[:, 0].isfinite()
        down, aside = (torch.where(there, offset, 0) for offset in offsets.unbind(1))
        rows, columns = log_r.shape[2:]
        row = torch.arange(rows, device=log_r.device)[:, None] + down.long()
        column = (torch.arange(columns, device=log_r.device) + aside.long()) % columns
        place = (row * columns + column).flatten(1)
        near, of = ((v.flatten(1).gather(1, place).view_as(down) * there) for v in (log_r, strength))
        pairs = (0, down.abs()[:, :2]), (2, aside.abs()[:, 2:])
        between = [_between(near[:, i : i + 2], of[:, i : i + 2], apart) for i, apart in pairs]
        ranges = torch.cat([near, *(one for one, _ in between)], 1)
        strengths = torch.cat([of, *(one for _, one in between)], 1)
        there = torch.cat([there, there.unflatten(1, (2, 2)).all(2)], 1)
        order = torch.tensor([4, 5, 0, 1, 2, 3], device=log_r.device)
        first = order[there[:, order].int().argmax(1, keepdim=True)]
        some = there.any(1, keepdim=True)
        guess, usual = torch.where(some, ranges.gather(1, first), math.log(10)), strengths.gather(1, first) * some
        return cls(down, aside, ranges, strengths, there, guess, usual)


class Surroundings(NamedTuple):
    """What the known rays say of every ray.

    Attributes:
        features: (B, `FEATURES`, H, W), of which none changes when all ranges are scaled, but one.
        ranges: log r of the candidates, (B, 6, H, W): the neighbours above, below, left and right, and the values
            between the first and the last two, linear in 1 / r.
        strengths: Their reflectance, (B, 6, H, W); zeros of a model of range alone.
        there: Which candidates there are, (B, 6, H, W) bool.
        guess: The candidate that is taken for the ray before anything is learned, log r, (B, 1, H, W).
        start: It and its reflectance in model space, (B, C, H, W).
        sure: 1 of a measured return, -1 of a ray that was measured empty, 0 of a hidden one, (B, 1, H, W).
    """

    features: Tensor
    ranges: Tensor
    strengths: Tensor
    there: Tensor
    guess: Tensor
    start: Tensor
    sure: Tensor


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


class RowFeatures(nn.Embedding):
    """What a network is told of each row: a learned vector, elevation, angles between rows and between columns.

    The vector is that of a row of the trained images, or of two together; rows of any other sensor have one for all.

    Args:
        elevations: Of the trained rows in radians, (H,).
    """

    FEATURES = ROW + 3

    def __init__(self, elevations: Tensor) -> None:
        pairs = elevations.unflatten(0, (-1, 2)).mean(1) if len(elevations) % 2 == 0 else elevations[:0]
        rows = torch.cat([elevations, pairs])
        super().__init__(1 + len(rows), ROW)
        self.elevations = rows  # no buffer: they follow from the sensor

    def forward(  # type: ignore[override]
        self, elevations: Tensor, steps: Tensor, known: Tensor | None = None
    ) -> Tensor:
        """(B, `FEATURES`, H, 1).

        Args:
            elevations: Of the rows in radians, (B, H).
            steps: Angle between rows and between columns, (B, 2).
            known: Whether the learned vectors are told, (B,) bool; None for yes.
        """
        off = (elevations[..., None] - self.elevations.to(elevations)).abs()
        same = (off.amin(-1) < SAME).all(1)
        number = (off.argmin(-1) + 1) * (same if known is None else same & known)[:, None]
        sizes = (steps / 0.007).log()[:, None].expand(*elevations.shape, 2)
        each = torch.cat([super().forward(number), 3 * elevations[..., None], sizes], -1)
        return each.movedim(-1, 1)[..., None]


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

    # -- what is known -------------------------------------------------------------------------------------------------

    def surroundings(self, condition: Condition, ring: bool, steps: Tensor) -> Surroundings:
        """What the known rays say of every ray.

        Args:
            condition: `image` and `known` of `r2flow.generators.condition_of`; guesses in it are not read.
            ring: Whether the columns are a full turn.
            steps: Angle between rows and between columns in radians, (B, 2).
        """
        image, known = condition[IMAGE].float(), condition[KNOWN].float()
        measured = known[:, :1]
        metres = self.space.decode(image) * measured
        r = metres[:, :1]
        strength = metres[:, 1:2] * known[:, -1:] if self.space.encoding.reflectance else torch.zeros_like(r)
        returned = r > 0
        log_r = torch.where(returned, r, 1.0).log()
        down, aside, ranges, strengths, there, guess, usual = Candidates.of(log_r, strength, returned, steps, ring)
        nothing = ~there.any(1, keepdim=True)
        far = self.space.sensor.max_range
        start = self._encode(guess.exp().clamp(self.space.sensor.min_range, far), usual)
        relative = (ranges - guess) * there
        features = torch.cat(
            [
                there[:, :4], relative[:, :4].clamp(-3, 3), strengths[:, :4], down.asinh() / 2, aside.asinh() / 2,
                there[:, 4:], relative[:, 4:].clamp(-3, 3), measured, returned, known[:, -1:],
                ((log_r - guess) * returned).clamp(-3, 3), strength, nothing, guess / 3 - 1,
            ], 1
        )  # fmt: skip
        sure = measured * torch.where(returned, 1, -1)
        return Surroundings(features, ranges, strengths, there, guess, torch.where(measured > 0, image, start), sure)

    def _encode(self, r: Tensor, strength: Tensor) -> Tensor:
        """Metres and reflectance, (B, 1, H, W) each, to model space."""
        reflectance = self.space.encoding.reflectance
        return self.space.encoding.encode(torch.cat([r, strength.clamp(0, 1)], 1) if reflectance else r)

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

    # -- the flow ------------------------------------------------------------------------------------------------------

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        return self._toward(t, x, condition, last=False)

    def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None) -> Tensor:
        """The velocity, and to s = 1 that of the straight line to the answer."""
        return self._toward(t, x, condition, last=bool((torch.as_tensor(s) >= 1).all()))

    def map(self, condition: Condition | None = None) -> MeanVelocity:
        """u(t, x, s) under a condition."""
        return Conditioned(self, condition or {})

    def _toward(self, t: Tensor, x: Tensor, condition: Condition | None, last: bool) -> Tensor:
        image, known = parts_of(condition, x)
        assert condition is not None
        about = Surroundings(*(condition[name] for name in Surroundings._fields))
        t = torch.as_tensor(t, device=x.device, dtype=torch.float32)
        answers = self.answers(t, x.float(), about, condition["rows"])
        x_1 = torch.where(known > 0, image, self._chosen(answers) if last else self._mean(answers))
        return ((x_1 - x) / (1 - expand_time(t, x)).clamp(min=LAST)).to(x)

    def transported(self, x_0: Tensor, condition: Condition) -> Tensor:
        """x_1 by the monotone map of each ray's noise e to its density, in one evaluation: log r = F^-1(Phi(e)).

        That is the optimal transport between the two, ray by ray: of many x_0 as many returns, and ranges, as the
        network expects. Rays do not know of one another.
        """
        image, known = parts_of(condition, x_0)
        about = Surroundings(*(condition[name] for name in Surroundings._fields))
        answers = self.answers(torch.zeros((), device=x_0.device), x_0.float(), about, condition["rows"])
        u = torch.special.ndtr((x_0 - about.start)[:, :1].float() / max(self.sigma, 1e-6))
        p = answers.returns.sigmoid()
        log_r = answers.quantile((u / p).clamp(1e-6, 1 - 1e-6))
        strength = answers.strengths.gather(1, answers.likeliest(log_r))
        return torch.where(known > 0, image, self._encode(self._within(log_r) * (u < p), strength * (u < p)))

    def _chosen(self, answers: Answers) -> Tensor:
        best = answers.least_error()
        r = self._within(answers.ranges.gather(1, best))
        return self._encode(r * (answers.returns > 0), answers.strengths.gather(1, best) * (answers.returns > 0))

    def _mean(self, answers: Answers) -> Tensor:
        p, q = answers.logits.exp(), answers.returns.sigmoid()
        r = self._within(answers.ranges)
        each = self._encode(r.flatten(0, 1)[:, None], answers.strengths.flatten(0, 1)[:, None])
        mean = (each.unflatten(0, p.shape[:2]) * p[:, :, None]).sum(1)
        nothing = self._encode(torch.zeros_like(q), torch.zeros_like(q))
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
        about = self.surroundings(condition, True, steps)
        rows = self.rows(elevations, steps, steps.new_full((len(image),), self.numbered).bool())
        start = about.start + self.sigma * (known < 1) * noise.to(weight)
        made = super().forward(start, {**condition, **about._asdict(), "rows": rows}, **how)
        nothing = self._encode(torch.zeros_like(image[:, :1]), torch.zeros_like(image[:, :1]))
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
            steps: As in `surroundings`.
            rows: Of `RowFeatures`.
        """
        about = self.surroundings(condition, ring=False, steps=steps)
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


def steps_of(elevations: Tensor, column: float) -> Tensor:
    """Mean angle between rows, of elevations (B, H), and that between columns, (B, 2)."""
    row = (elevations[:, 0] - elevations[:, -1]).abs() / max(elevations.shape[1] - 1, 1)
    return torch.stack([row.clamp(min=1e-4), torch.full_like(row, column)], 1)


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


def _between(near: Tensor, of: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
    """log r and reflectance between two returns at distances, (B, 2, H, W) each: linear in 1 / r, (B, 1, H, W)."""
    share = (distance / distance.sum(1, keepdim=True).clamp(min=1)).flip(1)  # the nearer counts more
    return -((-near).exp() * share).sum(1, keepdim=True).clamp(min=1e-6).log(), (of * share).sum(1, keepdim=True)


def _mean_over(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp(min=1)
