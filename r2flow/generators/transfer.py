"""Rectified flow from an interpolated partial scan (plus noise), instead of pure noise, to the full scan."""

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from r2flow.backbones import build_backbone
from r2flow.errors import InputError, check
from r2flow.flow.maps import MeanVelocity
from r2flow.flow.path import expand_time
from r2flow.flow.solvers.solution import wide
from r2flow.generators.base import IMAGE, KNOWN, Condition, Generated, Generator
from r2flow.generators.flow import Conditioned, Flow
from r2flow.generators.surroundings import FEATURES, ROW, STEEP, RowFeatures, Surroundings, encoded, steps_of
from r2flow.lidar.encoding import ModelSpace
from r2flow.processes import averaged
from r2flow.registry import NonNegative
from r2flow.samplers import Jump

LAST = 1e-5  # smallest 1 - t that the velocity is divided by
CANDIDATES = 7  # six of `Surroundings` and one predicted freely by the network
FREE, SHIFT = 0.3, 0.02  # log r per unit of network output: of the free candidate, of a neighbour
NEVER = -1e4  # logit of a missing candidate
REFLECTANCE = 0.265  # mean reflectance of returns to which scans of other sensors are scaled: of simulated scans
FOREIGN = 0.5  # share of the correction of reflectance that is taken for other sensors: best on three real scans
RAISED = math.radians(3)  # other sensors: low rays are not lost as those that the training sensor's own car hides
TOGETHER = math.radians(1.5)  # correlation length of drawn answers: best panel on scans of KITTI raw and object
WEIGHTS = {"range": 1.0, "return": 2.0, "reflectance": 4.0}  # loss weights


@dataclass(frozen=True)
class Answers:
    """The network's prediction for every ray: p(x_1 | x_t, condition), a mixture over candidates."""

    logits: Tensor  # log probability of each candidate, given a return, (B, 7, H, W)
    ranges: Tensor  # log r of each candidate, (B, 7, H, W); the last one is predicted freely by the network
    scales: Tensor  # scale b of each candidate's Laplace density on log r, (B, 7, H, W)
    returns: Tensor  # logit of a return, (B, 1, H, W)
    strengths: Tensor  # reflectance of each candidate, (B, 7, H, W)

    def log_density(self, log_r: Tensor) -> Tensor:
        """log p(log r | return), (B, 1, H, W)."""
        each = self.logits - (2 * self.scales).log() - (log_r - self.ranges).abs() / self.scales
        return each.logsumexp(1, keepdim=True)

    def quantile(self, u: Tensor) -> Tensor:
        """Quantile of log r given a return, at u in (0, 1), (B, 1, H, W), by bisection."""
        p = self.logits.exp()
        low, high = (self.ranges - 20 * self.scales).amin(1, True), (self.ranges + 20 * self.scales).amax(1, True)
        for _ in range(28):
            middle = (low + high) / 2
            z = (middle - self.ranges) / self.scales
            below = (p * torch.where(z < 0, z.exp() / 2, 1 - (-z).exp() / 2)).sum(1, keepdim=True) < u
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return (low + high) / 2

    def likeliest(self, log_r: Tensor) -> Tensor:
        """Index of the candidate most likely to have produced log r, (B, 1, H, W)."""
        each = self.logits - self.scales.log() - (log_r - self.ranges).abs() / self.scales
        return each.argmax(1, keepdim=True)

    def least_error(self) -> Tensor:
        """Index k of the candidate with the smallest expected |log r - m_k|, (B, 1, H, W).

        E|m - X| = |m - m_j| + b_j exp(-|m - m_j| / b_j) for X from the Laplace density of candidate j.
        """
        p, errors = self.logits.exp(), []
        for k in range(CANDIDATES):
            distance = (self.ranges[:, k : k + 1] - self.ranges).abs()
            errors.append((p * (distance + self.scales * (-distance / self.scales).exp())).sum(1))
        missing = self.logits <= NEVER / 2
        return torch.stack(errors, 1).masked_fill(missing, torch.inf).argmin(1, keepdim=True)


class TransferFlow(Flow):
    """Rectified flow that starts at a partial scan: x_t = (1 - t) x_0 + t x_1 with x_0 = s(x_1) + sigma e.

    s keeps the known rays and interpolates the others from the nearest known returns. The network learns the density
    of x_1 given x_t and the condition, ray by ray: a mixture over candidates, among them these neighbours, which keeps
    edges sharp (variational flow matching, Eijkelboom et al. 2024). The velocity is that of the mixture's mean,

        v = (E[x_1 | x_t] - x_t) / (1 - t).

    A step that ends at t = 1 takes the candidate of least expected error instead, with the mean reflectance, or no
    return if that is more likely: one evaluation gives the median of each ray. The sampler `transport` draws
    diverse completions. Known rays are returned bit for bit. Images can have any size and sensor (`at`).

    Args:
        backbone: Name and options of a backbone for any size, as in conf/backbone/local.yaml.
        sigma: Standard deviation of the noise in x_0, in model space.
    """

    told, draws, singular, usual = True, False, True, Jump(steps=1)

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any], sigma: NonNegative = 0.25) -> None:
        super().__init__(space)
        self.sigma = sigma
        inputs = space.shape[0] + FEATURES + RowFeatures.FEATURES
        self.backbone = build_backbone(backbone, space.rays, inputs, 3 * CANDIDATES + 2)
        fits = self.backbone.any_size
        check(fits, f"a transfer flow needs a backbone for any size: give backbone=local, not {backbone['name']}.")
        self.rows = RowFeatures(space.rays[0, :, 0])
        self.elevations, self.numbered = space.rays[0, :, 0], True
        self.foreign = False  # whether the scans are of another sensor than the training scans

    def start_from(self, parent: Generator) -> None:
        """Copy a transfer flow's weights; for a sensor with other beams, each row starts from the shared vector."""
        weights = parent.state_dict()
        if isinstance(parent, TransferFlow) and not torch.equal(self.rows.elevations, parent.rows.elevations):
            weights["rows.weight"] = weights["rows.weight"][:1].expand_as(self.rows.weight)
        self._take(parent, {**weights, "backbone.coords": self.backbone.coords})

    def at(self, space: ModelSpace, numbered: bool = True) -> Self:
        """This flow for another sensor, with shared weights; `numbered`: use the vectors learned per row."""
        part = copy(self)
        part.space, part.noise_shape, part.elevations = space, space.shape, space.rays[0, :, 0]
        part.foreign = self.foreign or not numbered or space.sensor.name != self.space.sensor.name
        part.numbered = numbered
        return part

    def answers(self, t: Tensor, x: Tensor, about: Surroundings, rows: Tensor) -> Answers:
        """p(x_1 | x_t, condition) at times t, (B,) or (), with x = x_t, (B, C, H, W); `rows` are of `RowFeatures`."""
        inputs = torch.cat([x - about.start, about.features, rows.expand(len(x), -1, *x.shape[2:])], 1)
        output = self.backbone(t, inputs).float()
        if self.foreign:
            raised = inputs.clone()
            raised[:, ROW - RowFeatures.FEATURES] += STEEP * RAISED  # the elevation, among the last inputs
            output[:, -2] = self.backbone(t, raised).float()[:, -2]
        logits, shifts, scales = output[:, :-2].chunk(3, 1)
        returns, strength = output[:, -2:].split(1, 1)
        logits = torch.cat([logits[:, :4], logits[:, 4:5] + 2, logits[:, 5:6] + 1, logits[:, 6:]], 1)
        present = torch.cat([about.there, torch.ones_like(about.there[:, :1])], 1)
        logits = logits.masked_fill(~present, NEVER).log_softmax(1)
        ranges = torch.cat([about.ranges + SHIFT * shifts[:, :6], about.guess + FREE * shifts[:, 6:]], 1)
        scales = (scales - 4).clamp(max=2).exp() + 1e-3  # of Laplace densities on log r
        nearest = about.strengths.gather(1, about.there.int().argmax(1, keepdim=True))
        strengths = torch.cat([about.strengths, nearest], 1) + strength * (FOREIGN if self.foreign else 1.0)
        returns = torch.where(about.sure != 0, -NEVER * about.sure, returns + 1)
        return Answers(logits, ranges, scales, returns, strengths.clamp(0, 1) if not self.training else strengths)

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        return self.mean_velocity(t, x, torch.zeros(()), condition)

    def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None) -> Tensor:
        """The velocity; for s = 1, that of the straight line to the point estimate of x_1."""
        assert condition is not None
        t = torch.as_tensor(t, device=x.device, dtype=torch.float32)
        answers = self._answered(t, x, condition)
        estimate = self._chosen if bool((torch.as_tensor(s) >= 1).all()) else self._mean
        x_1 = torch.where(condition[KNOWN] > 0, condition[IMAGE], estimate(answers)).to(x)
        return ((x_1 - x) / (1 - expand_time(t, x)).clamp(min=LAST)).to(x)

    def map(self, condition: Condition | None = None) -> MeanVelocity:
        return Conditioned(self, condition or {})

    def transported(self, x_0: Tensor, condition: Condition, residual: float) -> Tensor:
        """x_1 in one evaluation, by the monotone map of a normal number z per ray to its density: log r = F^-1(Phi(z)).

        This is the optimal transport between the two in one dimension. z is the noise, smoothed so that neighbouring
        rays agree on an edge or a gap (a Gaussian copula). The deviation of log r from the candidate that most likely
        produced it is multiplied by `residual`.
        """
        answers = self._answered(torch.zeros((), device=x_0.device), x_0, condition)
        e = (x_0 - condition["start"])[:, :1].float() / max(self.sigma, 1e-6)
        u = torch.special.ndtr(smoothed(e, condition[KNOWN][:, :1] < 1, self.elevations))
        p = answers.returns.sigmoid()
        log_r = answers.quantile((u / p).clamp(1e-6, 1 - 1e-6))
        k = answers.likeliest(log_r)
        log_r, strength = answers.ranges.gather(1, k).lerp(log_r, residual), answers.strengths.gather(1, k)
        x_1 = encoded(self.space, self._within(log_r) * (u < p), strength * (u < p))
        return torch.where(condition[KNOWN] > 0, condition[IMAGE], x_1)

    def _answered(self, t: Tensor, x: Tensor, condition: Condition) -> Answers:
        about = Surroundings(*(condition[name] for name in Surroundings._fields))
        return self.answers(t, x.float(), about, condition["rows"])

    def _chosen(self, answers: Answers) -> Tensor:
        r = self._within(answers.ranges.gather(1, answers.least_error()))
        strength = (answers.logits.exp() * answers.strengths).sum(1, keepdim=True)
        return encoded(self.space, r * (answers.returns > 0), strength * (answers.returns > 0))

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
            raise InputError("this model completes scans: give one of which a ray is known, as r2flow complete does.")
        weight = wide(next(self.parameters()))  # known rays stay as they are for weights of half precision
        condition = {name: value.to(weight) for name, value in condition.items()}
        image, known = condition[IMAGE], condition[KNOWN]
        # Another sensor's intensities have another scale than those that the network has seen.
        gain = gain_of(self.space, image, known) if self.space.encoding.reflectance and self.foreign else None
        if gain is not None:
            condition[IMAGE] = scaled(image, gain)
        elevations = self.elevations.to(weight)[None].expand(len(image), -1)
        steps = steps_of(elevations, 2 * math.pi / image.shape[3])
        about = Surroundings.of(self.space, condition, True, steps)
        rows = self.rows(elevations, steps, steps.new_full((len(image),), self.numbered).bool())
        start = about.start + self.sigma * (known < 1) * noise.to(weight)
        generated = super().forward(start, {**condition, **about._asdict(), "rows": rows}, **how)
        nothing = encoded(self.space, torch.zeros_like(image[:, :1]), torch.zeros_like(image[:, :1]))
        x = generated.x.to(image)
        x = x if gain is None else scaled(x, 1 / gain)
        x = torch.where(known > 0, image, torch.where(_within_reach(known[:, :1]), x, nothing))
        return replace(generated, x=x, evaluations=generated.evaluations * (1 + self.foreign))  # see `answers`

    def loss(
        self, x_1: Tensor, condition: Condition, t: Tensor, noise: Tensor, steps: Tensor, rows: Tensor
    ) -> Mapping[str, Tensor]:
        """Losses over the hidden rays: negative log-likelihood of log r and of a return, mean |error| of reflectance.

        x_1, (B, C, H, W), are crops that do not span a full turn, t their times, (B,); `steps` are those of
        `Surroundings.of`, `rows` the output of `RowFeatures`. In training each loss is the mean over the rays of
        the batch (of an accumulated part), on all devices, in eval mode the mean over the scans' own losses.
        """
        about = Surroundings.of(self.space, condition, ring=False, steps=steps)
        known = condition[KNOWN]
        x_0 = about.start + self.sigma * (known < 1) * noise
        times = expand_time(t, x_1)
        answers = self.answers(t, torch.where(known > 0, x_1, (1 - times) * x_0 + times * x_1), about, rows)
        metres = self.space.decode(x_1)
        returned, hidden = metres[:, :1] > 0, known[:, :1] < 1
        log_r = torch.where(returned, metres[:, :1], 1.0).log()
        mask = (returned & hidden).float()
        dims = (0, 1, 2, 3) if self.training else (1, 2, 3)

        def mean(values: Tensor, weight: Tensor) -> Tensor:
            total = averaged(weight.sum(dims)) if self.training else weight.sum(dims)
            return ((values * weight).sum(dims) / total.clamp(min=1)).mean()

        surprise = F.binary_cross_entropy_with_logits(answers.returns, returned.float(), reduction="none")
        losses = {"range": -mean(answers.log_density(log_r), mask), "return": mean(surprise, hidden.float())}
        if self.space.encoding.reflectance:
            errors = (answers.strengths - metres[:, 1:2]).abs()
            losses["reflectance"] = mean((answers.logits.detach().exp() * errors).sum(1, keepdim=True), mask)
        return losses


def smoothed(e: Tensor, hidden: Tensor, elevations: Tensor) -> Tensor:
    """Standard normal numbers of hidden rays, (B, 1, H, W), correlated over `TOGETHER` in both angles.

    z = sum_k w_k e_k / sqrt(sum_k w_k^2) over hidden rays k, with e_k independent and w_k = exp(-d^2 / 2) for d the
    angle over `TOGETHER`. Other rays get no meaningful number. Elevations are those of the rows in radians, (H,).
    """
    rows, columns = e.shape[2:]
    steps = (abs(float(elevations[0] - elevations[-1])) / max(rows - 1, 1), 2 * math.pi / columns)
    weights = []
    for step in steps:
        reach = int(3 * TOGETHER / max(step, 1e-3)) + 1
        distance = torch.arange(-reach, reach + 1, dtype=torch.float64, device=e.device) * step / TOGETHER
        weights.append(torch.exp(-0.5 * distance**2))  # float64: neither autocast nor TF32 rounds it

    def convolved(x: Tensor, down: Tensor, along: Tensor) -> Tensor:
        x = F.conv2d(x, down[None, None, :, None], padding=(len(down) // 2, 0))
        side = len(along) // 2
        return F.conv2d(F.pad(x, (side, side, 0, 0), "circular"), along[None, None, None])

    variance = convolved(hidden.to(weights[0]), *(w**2 for w in weights))
    return (convolved(e.double() * hidden, *weights) / variance.clamp(min=1e-12).sqrt()).to(e)


def gain_of(space: ModelSpace, image: Tensor, known: Tensor) -> Tensor:
    """Factor from each scan's mean reflectance to `REFLECTANCE`, (B, 1, 1, 1); 1 without known reflectance."""
    metres = space.decode(image)
    returned = (known[:, -1:] > 0) & (metres[:, :1] > 0)
    total = (metres[:, 1:] * returned).sum((1, 2, 3), keepdim=True)
    return torch.where(total > 0, REFLECTANCE * returned.sum((1, 2, 3), keepdim=True) / total, 1.0)


def scaled(image: Tensor, gain: Tensor) -> Tensor:
    """An image in model space, (B, C, H, W), with its reflectance multiplied, at most 1."""
    return torch.cat([image[:, :-1], ((image[:, -1:] + 1) * gain).clamp(max=2) - 1], 1)


def _within_reach(known: Tensor) -> Tensor:
    """Rows, (B, 1, H, 1), between measured rows or within their largest gap beyond them; `known` is (B, 1, H, W)."""
    reach = known[:, 0].any(2)
    number = torch.arange(known.shape[2], device=known.device)
    for rows in reach:
        if len(measured := rows.nonzero()[:, 0]):
            gap = measured.diff().max() if len(measured) > 1 else len(rows)
            rows.copy_((number > measured[0] - gap) & (number < measured[-1] + gap))
    return reach[:, None, :, None]
