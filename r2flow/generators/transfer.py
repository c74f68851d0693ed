"""Rectified flow from an interpolated partial scan (plus noise), instead of noise, to the scan."""

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from r2flow.backbones import BACKBONES
from r2flow.base.errors import InputError
from r2flow.base.processes import mean_over_processes
from r2flow.base.registry import NonNegative
from r2flow.flow.maps import MeanVelocity
from r2flow.flow.path import expand_time
from r2flow.flow.solvers.solution import wide
from r2flow.generators.answers import FAINT, NEVER, RAYS, Answers, smoothed
from r2flow.generators.base import (
    IMAGE,
    KNOWN,
    Condition,
    Generated,
    Generator,
    autocast,
    holds,
)
from r2flow.generators.calibration import Calibration
from r2flow.generators.flow import Conditioned, Flow
from r2flow.generators.surroundings import (
    FEATURES,
    ROW,
    STEEP,
    RowFeatures,
    Surroundings,
    encoded,
    every_second,
    first_present,
    gain_of,
    steps_of,
    within_reach,
)
from r2flow.lidar.encoding import ModelSpace
from r2flow.lidar.labels import COMMON
from r2flow.samplers import Jump

_LAST = 1e-5  # smallest 1 - t that the velocity is divided by
_CANDIDATES = 7  # six of `Surroundings` and one predicted freely by the network
_RETURN = 3 * _CANDIDATES  # output of the network: logit of a return
_STRENGTH = slice(_RETURN + 1, _RETURN + 2)  # and the correction of reflectance
# log r per unit of network output: of the free candidate, of a neighbour.
_FREE = 0.3
_SHIFT = 0.02
_OTHER = 0.02  # share of a class that the nearest returns have not, before the network speaks
# Other sensors: what a return in the wrong place costs, as a share of one where there is none.
_MISPLACED = 0.5
# Other sensors: low rays are not lost as those that the training sensor's own car hides.
RAISED = math.radians(3)
WEIGHTS = {"range": 1.0, "return": 2.0, "reflectance": 4.0, "label": 1.0}  # loss weights


class TransferFlow(Flow):
    """Rectified flow from a partial scan: x_t = (1 - t) x_0 + t x_1 with x_0 = s(x_1) + sigma e.

    s keeps the known rays and interpolates the others from the nearest known returns. The network
    learns the density of x_1 given x_t and the condition, ray by ray: a mixture over candidates,
    among them these neighbours, which keeps edges sharp (variational flow matching, Eijkelboom et
    al. 2024). The velocity is that of the mixture's mean,

        v = (E[x_1 | x_t] - x_t) / (1 - t).

    A step that ends at t = 1 takes the candidate of least expected error instead, with the mean
    reflectance, or no return if that is more likely: one evaluation gives the median of each ray.
    The sampler `transport` draws diverse completions. Known rays are returned bit for bit. Images
    can have any size and sensor (`at`).

    With labels, each channel of a ray is known or hidden by itself: labels of scans, scans of
    labels. The network gives a probability p of each class, and E[x_1] = 2 p - 1 in its plane.

    Args:
        backbone: Name and options of a backbone for any size, as in conf/backbone/local.yaml.
        sigma: Standard deviation of the noise in x_0, in model space.
        twice: Evaluate scans of other sensors twice, see `answers`; not for a network that has
            learned the ray-drop of the second evaluation.
    """

    takes_condition = True
    unconditional = False
    singular = True
    default_sampler = Jump(steps=1)

    def __init__(
        self,
        space: ModelSpace,
        backbone: Mapping[str, Any],
        sigma: NonNegative = 0.25,
        twice: bool = True,
    ) -> None:
        super().__init__(space)
        self.sigma = sigma
        self.twice = twice
        inputs = space.shape[0] + FEATURES + RowFeatures.FEATURES + space.encoding.labels
        self.classes = len(COMMON) if space.encoding.labels else 0
        outputs = 3 * _CANDIDATES + 2 + self.classes
        self.backbone = BACKBONES.build(
            backbone, space.rays, in_channels=inputs, out_channels=outputs
        )
        self.backbone.refuse_parametrised(type(self).__name__)
        if not self.backbone.any_size:
            raise InputError(
                "a transfer flow needs a backbone for any size: give backbone=local, not "
                f"{backbone['name']}."
            )
        self.elevations = space.rays[0, :, 0]
        self.rows = RowFeatures(self.elevations)
        self.numbered = True  # whether the vectors learned per row are used
        self.foreign = False  # whether the scans are of another sensor than the training scans
        self.density: Answers | None = None  # of the last step of one call
        self.calibration: Calibration | None = None

    def start_from(self, parent: Generator) -> None:
        """Copy a transfer flow's weights; those of labels that it does not know begin at 0.

        For a sensor with other beams, each row starts from the shared vector.
        """
        weights = parent.state_dict()
        if isinstance(parent, TransferFlow) and not parent.classes:
            weights = {name: self._widened(name, weight) for name, weight in weights.items()}
        beams = parent.rows.elevations if isinstance(parent, TransferFlow) else None
        if beams is not None and not torch.equal(self.rows.elevations, beams):
            weights["rows.weight"] = weights["rows.weight"][:1].expand_as(self.rows.weight)
        self._take(parent, {**weights, "backbone.coords": self.backbone.coords})

    def _widened(self, name: str, weight: Tensor) -> Tensor:
        """A parent's weight with zeros for the channels of labels, which are the last."""
        if not name.startswith(("backbone.image.", "backbone.answer.")):
            return weight
        widened = self.get_parameter(name)
        wide = torch.zeros_like(widened)
        wide[tuple(map(slice, weight.shape))] = weight
        return wide

    def at(self, space: ModelSpace, numbered: bool = True) -> Self:
        """This flow for another sensor; `numbered`: use the vectors learned per row."""
        part = copy(self)
        part.space = space
        part.noise_shape = space.shape
        part.elevations = space.rays[0, :, 0]
        part.numbered = numbered
        other = space.sensor.name != self.space.sensor.name
        part.foreign = self.foreign or other or not numbered
        return part

    def answers(
        self,
        t: Tensor,
        x: Tensor,
        about: Surroundings,
        rows: Tensor,
        gain: Tensor | float = 1.0,
        share: Tensor | float = 1.0,
    ) -> Answers:
        """p(x_1 | x_t, condition) at times t, (B,) or (), with x = x_t, (B, C, H, W).

        Args:
            rows: The output of `RowFeatures`.
            gain: That of the `Surroundings`.
            share: Share of the learned correction of reflectance.
        """
        inputs = self._inputs(x, about, rows)
        output = self.backbone(t, inputs).float()
        if self.foreign and self.twice and holds((about.sure == 0).any()):
            elevation = x.shape[1] - self.classes + FEATURES + ROW
            inputs[:, elevation] += STEEP * RAISED
            output[:, _RETURN] = self.backbone(t, inputs).float()[:, _RETURN]
        return self._read(output, about, gain, share)

    def _inputs(self, x: Tensor, about: Surroundings, rows: Tensor) -> Tensor:
        rows = rows.expand(len(x), -1, *x.shape[2:])
        returns = x.shape[1] - self.classes  # channels of range and reflectance
        return torch.cat(
            [
                (x - about.start)[:, :returns],
                about.features,
                rows,
                x[:, returns:],
                about.labelled,
            ],
            1,
        )

    def _read(
        self, output: Tensor, about: Surroundings, gain: Tensor | float, share: Tensor | float
    ) -> Answers:
        """The answers in an output of the network."""
        correction = share * output[:, _STRENGTH]
        output, labels = output.tensor_split([3 * _CANDIDATES + 2], 1)
        logits, shifts, scales = output[:, :-2].chunk(3, 1)
        # The interpolations are likelier at first.
        logits = logits + logits.new_tensor([0, 0, 0, 0, 2, 1, 0])[:, None, None]
        present = F.pad(about.there, (0, 0, 0, 0, 0, 1), value=True)
        logits = logits.masked_fill(~present, NEVER).log_softmax(1)
        near = about.ranges + _SHIFT * shifts[:, :6]
        ranges = torch.cat([near, about.guess + _FREE * shifts[:, 6:]], 1)
        scales = (scales - 4).clamp(max=2).exp() + 1e-3
        nearest = first_present(about.strengths, about.there, range(4), about.strengths[:, :1])
        strengths = (torch.cat([about.strengths, nearest], 1) + correction) / gain
        if not self.training:
            strengths = strengths.clamp(0, 1)
        sure = torch.where(about.sure != 0, -NEVER * about.sure, output[:, -2:-1] + 1)
        # So are the labels of the nearest returns.
        classes = about.start.shape[1] - self.classes
        copied = (about.start[:, classes:] + 1) / 2 + _OTHER
        labels = (labels + copied.log()).log_softmax(1)
        return Answers(logits, ranges, scales, sure, strengths, labels, FAINT / gain)

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        return self.mean_velocity(t, x, torch.zeros(()), condition)

    def mean_velocity(
        self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None
    ) -> Tensor:
        """The velocity; for s = 1, that of the straight line to the point estimate of x_1."""
        assert condition is not None
        t = torch.as_tensor(t, device=x.device, dtype=torch.float32)
        if holds((torch.as_tensor(s) >= 1).all()):
            x_1 = self._estimate(t, x, condition)
        else:
            self.density = None
            x_1 = self._mean(self._answered(t, x, condition))
        x_1 = _with_known(condition, x_1).to(x)
        return ((x_1 - x) / (1 - expand_time(t, x)).clamp(min=_LAST)).to(x)

    def map(self, condition: Condition | None = None) -> MeanVelocity:
        return Conditioned(self, condition or {})

    def transported(self, x_0: Tensor, condition: Condition, residual: float) -> Tensor:
        """x_1 in one evaluation, by the monotone map of a normal number z per ray to its density.

        log r = F^-1(Phi(z)) is the optimal transport between the two in one dimension. z is the
        noise, smoothed so that neighbouring rays agree on an edge or a gap (a Gaussian copula). The
        deviation of log r from the candidate that most likely produced it is multiplied by
        `residual`.
        """
        self.density = self._answered(torch.zeros((), device=x_0.device), x_0, condition)
        answers = self.density.calibrated()
        e = (x_0 - condition["start"])[:, :1].float() / max(self.sigma, 1e-6)
        u = torch.special.ndtr(smoothed(e, condition[KNOWN][:, :1] < 1, self.elevations))
        p = answers.returns.sigmoid()
        log_r = answers.quantile((u / p).clamp(1e-6, 1 - 1e-6))
        k = answers.likeliest(log_r)
        log_r = answers.ranges.gather(1, k).lerp(log_r, residual)
        strength = answers.strengths.gather(1, k)
        returned = u < p
        x_1 = encoded(self.space, self._within(log_r) * returned, strength * returned)
        return _with_known(condition, _labelled(x_1, answers, returned))

    def _answered(self, t: Tensor, x: Tensor, condition: Condition) -> Answers:
        about = Surroundings(*(condition[name] for name in Surroundings._fields))
        how = (condition[name] for name in ("rows", "gain", "share"))
        answers = self.answers(t, x.float(), about, *how)
        return replace(answers, calibration=self.calibration_of_sensor)

    @property
    def calibration_of_sensor(self) -> Calibration | None:
        """The model's calibration with the factors of the scans' sensor."""
        factors = self.space.sensor.error_factors
        if factors is None:
            return self.calibration
        return replace(self.calibration or Calibration(), factors=factors)

    def _estimate(self, t: Tensor, x: Tensor, condition: Condition) -> Tensor:
        """The point estimate of x_1, computed where a ray is hidden and likely to return alone."""
        if torch.compiler.is_exporting():  # runtimes prefer fixed shapes
            self.density = self._answered(t, x, condition)
            return self._chosen(self.density)
        known = condition[KNOWN]
        asked = (known < 1).any(1, keepdim=True) & within_reach(known.amax(1, True))
        near = self._rows_near(asked)
        part = {name: value[:, :, near] for name, value in condition.items() if value.shape[2] > 1}
        answers = self._answered(t, x[:, :, near], {**condition, **part})
        likely = (asked[:, :, near] & (answers.returns > 0)).flatten().nonzero()[:, 0]
        x_1 = self._empty(known[:, :1])
        rows = x_1[:, :, near].movedim(1, 0)
        flat = rows.flatten(1).clone()
        for rays in likely.split(RAYS):
            flat[:, rays] = self._chosen(answers.of(rays))[0, :, 0]
        x_1[:, :, near] = flat.view_as(rows).movedim(1, 0)
        self.density = answers.among(x_1.shape[2], near)
        return x_1

    def _rows_near(self, asked: Tensor) -> slice:
        """The rows that the network needs to answer the rays asked, (B, 1, H, W)."""
        rows = asked.shape[2]
        if self.backbone.radius is None or torch.compiler.is_exporting():
            return slice(0, rows)
        number = asked.any(3).any(0)[0].nonzero()[:, 0].tolist() or [0]
        radius = self.backbone.radius
        return slice(max(number[0] - radius, 0), min(number[-1] + radius + 1, rows))

    def _share(self, condition: Condition, noise: Tensor, steps: Tensor) -> Tensor:
        """Share of the learned correction of reflectance that suits each scan, (B, 1, 1, 1).

        Some sensors are unlike those of training. Of the measured rows every second is hidden, in a
        quarter of the columns: the share has the least error there. It is 1 if that tells nothing.
        """
        columns = noise.shape[3]
        front = slice(3 * columns // 8, 5 * columns // 8 + 1)
        image, known, noise = (x[..., front] for x in (condition[IMAGE], condition[KNOWN], noise))
        gain = condition["gain"]
        hidden = every_second(known[:, :1])
        kept = known * ~hidden
        about = Surroundings.of(self.space, {IMAGE: image, KNOWN: kept}, False, steps, gain)
        metres = self.space.decode(image)
        heard = known[:, 1][:, None] > 0  # not a slice: OpenVINO 2026.4 refuses the exported graph
        compared = hidden & heard & (metres[:, :1] > 0)
        near = self._rows_near(compared)
        compared, metres, kept, noise, rows = (
            x[:, :, near] for x in (compared, metres, kept, noise, condition["rows"])
        )
        about = Surroundings(*(x[:, :, near] for x in about))
        inputs = self._inputs(about.start + (kept < 1) * noise, about, rows)
        output = self.backbone(torch.zeros((), device=noise.device), inputs).float()
        error = metres[:, 1:2] - self._read(output, about, gain, 0.0).strength()
        correction = output[:, _STRENGTH] / gain
        shares = torch.linspace(1, 0, 11, device=noise.device)
        errors = [
            (compared * (error - share * correction).abs()).sum((1, 2, 3)) for share in shares
        ]
        return shares[torch.stack(errors).argmin(0)][:, None, None, None]

    def _chosen(self, answers: Answers) -> Tensor:
        log_r = answers.ranges.gather(1, answers.least_error())
        returned = answers.returns > 0
        if self.foreign:
            # Least expected cost: 1 of a wrong ray-drop, less of a return in the wrong place.
            misplaced = _MISPLACED * (1 - answers.hits(log_r))
            returned = answers.returns.sigmoid() * (2 - misplaced) > 1
        strength = answers.strength()
        x_1 = encoded(self.space, self._within(log_r) * returned, strength * returned)
        return _labelled(x_1, answers, returned)

    def _mean(self, answers: Answers) -> Tensor:
        p = answers.logits.exp()
        q = answers.returns.sigmoid()
        r = self._within(answers.ranges).flatten(0, 1)
        each = encoded(self.space, r[:, None], answers.strengths.flatten(0, 1)[:, None])
        mean = (each.unflatten(0, p.shape[:2]) * p[:, :, None]).sum(1)
        return q * _labelled(mean, answers) + (1 - q) * self._empty(q)

    def _empty(self, like: Tensor) -> Tensor:
        """Rays without a return in model space, (B, C, H, W), in the type of (B, 1, H, W)."""
        zeros = torch.zeros_like(like)
        planes = like.new_full((len(like), self.classes, *like.shape[2:]), -1)
        return torch.cat([encoded(self.space, zeros, zeros), planes], 1)

    def _within(self, log_r: Tensor) -> Tensor:
        sensor = self.space.sensor
        return log_r.clamp(max=10).exp().clamp(sensor.min_range, sensor.max_range)

    @torch.no_grad()
    def forward(self, noise: Tensor, condition: Condition | None = None, **how: Any) -> Generated:
        if condition is None:
            raise InputError(
                "this model completes scans: give one of which a ray is known, as r2flow complete."
            )
        # Known rays stay as they are for weights of half precision.
        weight = wide(next(self.parameters()))
        image = condition[IMAGE].to(weight)
        known = condition[KNOWN].to(weight)
        measured = {IMAGE: image, KNOWN: known}
        gain = torch.ones_like(image[:, :1, :1, :1])
        scaled = self.space.encoding.reflectance and self.foreign
        if scaled:
            # Its intensities have another scale than those that the network has seen.
            gain = gain_of(self.space, image, known)
        elevations = self.elevations.to(weight)[None].expand(len(image), -1)
        steps = steps_of(elevations, 2 * math.pi / image.shape[3])
        about = Surroundings.of(self.space, measured, True, steps, gain)
        numbered = torch.tensor(self.numbered, device=weight.device).expand(len(image))
        measured["rows"] = self.rows(elevations, steps, numbered)
        noise = self.sigma * noise.to(weight)
        measured |= {"gain": gain, "share": torch.ones_like(gain)}
        hidden = holds((known[:, :1] < 1).any())  # else labels alone are drawn
        tested = scaled and hidden and holds((gain != 1).any())
        if tested:
            with autocast(self.device, how.get("precision", "32-true")):
                measured["share"] = self._share(measured, noise, steps)
        start = about.start + (known < 1) * noise
        once = copy(self)  # threads share a generator
        generated = Flow.forward(once, start, {**measured, **about._asdict()}, **how)
        x = generated.x.to(image)
        x = torch.where(within_reach(known.amax(1, True)), x, self._empty(image[:, :1]))
        x = torch.where(known > 0, image, x)
        # See `answers` and `_share`.
        twice = self.foreign and self.twice and hidden
        evaluations = generated.evaluations * (2 if twice else 1) + tested
        return replace(generated, x=x, evaluations=evaluations, density=once.density)

    def loss(
        self,
        x_1: Tensor,
        condition: Condition,
        t: Tensor,
        noise: Tensor,
        steps: Tensor,
        rows: Tensor,
    ) -> Mapping[str, Tensor]:
        """Losses over the hidden rays, by name (`WEIGHTS`).

        They are the negative log-likelihoods of log r, of a return and of a label, and the mean
        |error| of reflectance. In training each is the mean over the rays of the batch (of an
        accumulated part), on all devices, in eval mode the mean over the scans' own losses.

        Args:
            x_1: Crops, (B, C, H, W), that do not span a full turn.
            t: Their times, (B,).
            steps: See `Surroundings.of`.
            rows: The output of `RowFeatures`.
        """
        about = Surroundings.of(self.space, condition, ring=False, steps=steps)
        known = condition[KNOWN]
        x_0 = about.start + self.sigma * (known < 1) * noise
        x_t = torch.where(known > 0, x_1, x_0.lerp(x_1, expand_time(t, x_1)))
        answers = self.answers(t, x_t, about, rows)
        metres = self.space.decode(x_1)
        returned = metres[:, :1] > 0
        hidden = known[:, :1] < 1
        log_r = torch.where(returned, metres[:, :1], 1.0).log()
        dims = (0, 1, 2, 3) if self.training else (1, 2, 3)

        def mean(values: Tensor, weight: Tensor) -> Tensor:
            total = weight.float().sum(dims)
            if self.training:
                total = mean_over_processes(total)
            return ((values * weight).sum(dims) / total.clamp(min=1)).mean()

        surprise = F.binary_cross_entropy_with_logits(
            answers.returns, returned.float(), reduction="none"
        )
        losses = {
            "range": -mean(answers.log_density(log_r), returned & hidden),
            "return": mean(surprise, hidden),
        }
        if self.space.encoding.reflectance:
            errors = answers.logits.detach().exp() * (answers.strengths - metres[:, 1:2]).abs()
            losses["reflectance"] = mean(errors.sum(1, keepdim=True), returned & hidden)
        if self.classes:
            share = (x_1[:, -self.classes :] + 1) / 2
            entropy = -(share * answers.labels).sum(1, keepdim=True)
            labelled = share.any(1, keepdim=True) & (known[:, -1:] < 1)
            losses["label"] = mean(entropy, returned & labelled)
        return losses


def _labelled(x: Tensor, answers: Answers, returned: Tensor | float = 1.0) -> Tensor:
    """Range and reflectance with the mean of each plane of labels; no label without a return."""
    return torch.cat([x, 2 * answers.labels.exp().to(x) * returned - 1], 1)


def _with_known(condition: Condition, x: Tensor) -> Tensor:
    return torch.where(condition[KNOWN] > 0, condition[IMAGE], x)
