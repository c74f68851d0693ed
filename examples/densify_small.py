"""The stage that made `densify_small`: half of its loss is the distance to the answers of `densify`.

r2flow train --plugin examples/densify_small.py experiment=densify stage.name=learn_from_densify name=small \
    backbone.channels=32 'backbone.dilations=[1,2,4,8]' +generator.name=transfer_flow +generator.twice=false \
    trainer.precision=bf16-mixed trainer.max_steps=19000
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.generators.base import IMAGE, KNOWN
from r2flow.generators.surroundings import ROW, STEEP, Surroundings
from r2flow.generators.transfer import RAISED, WEIGHTS, Answers
from r2flow.model.checkpoint import load_checkpoint
from r2flow.stages import STAGES
from r2flow.stages.base import Batch
from r2flow.stages.transfer import Transfer


class LearnFromDensify(Transfer):
    """Train a small transfer flow on true scans and on the answers of `densify`, half and half.

    Crops without vectors of their rows, as of other sensors, learn the ray-drop of the second
    evaluation of `densify`, at rows 3 degrees higher, whatever their elevation: it is off by -3 to
    +6 degrees.
    """

    def __init__(self, *model: Any, **options: Any) -> None:
        super().__init__(*model, **options)
        teacher = load_checkpoint("densify").generator.eval().requires_grad_(False)
        self.__dict__["teacher"] = teacher  # no part of the checkpoint
        self.generator.rows.load_state_dict(teacher.rows.state_dict())
        self.generator.rows.requires_grad_(False)

    def on_fit_start(self) -> None:
        self.teacher.to(self.device)

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        if not self.training:
            return super().regression_loss(batch, u)
        flow = self.generator
        x_1 = batch["x_1"]
        known = batch[KNOWN]
        condition = {IMAGE: batch[IMAGE], KNOWN: known}
        t = (4 * u - 3).clamp(min=0)  # 3/4 of the images at t = 0
        noise = batch["x_0"][:, :, : x_1.shape[2], : x_1.shape[3]]
        rows = flow.rows(batch["elevations"], batch["steps"], batch["numbered"])
        shared = flow.rows.weight[0][:, None]  # of rows that have no vector of their own
        foreign = (rows[:, :ROW, :, 0] == shared).all(2).all(1)
        offset = STEEP * RAISED * (3 * torch.rand(len(rows), device=rows.device) - 1) * foreign
        shifted = rows.clone()
        shifted[:, ROW] += offset[:, None, None]
        own = flow.loss(x_1, condition, t, noise, batch["steps"], shifted)
        about = Surroundings.of(flow.space, condition, ring=False, steps=batch["steps"])
        x_0 = about.start + flow.sigma * (known < 1) * noise
        x_t = torch.where(known > 0, x_1, x_0.lerp(x_1, expand_time(t, x_1)))
        with torch.no_grad():
            taught = self.teacher.answers(t, x_t, about, rows)
            higher = rows.clone()
            higher[:, ROW] += STEEP * RAISED
            drop = self.teacher.answers(t, x_t, about, higher).returns.sigmoid()
        returned = (flow.space.decode(x_1)[:, :1] > 0).float()
        target = torch.where(
            foreign[:, None, None, None], drop, (taught.returns.sigmoid() + returned) / 2
        )
        found = flow.answers(t, x_t, about, shifted)
        hidden = (known[:, :1] < 1).float()
        surprise = F.binary_cross_entropy_with_logits(found.returns, target, reduction="none")
        losses = {"return": (surprise * hidden).sum() / hidden.sum().clamp(min=1)}
        for name, value in distances(taught, found, hidden).items():
            losses[name] = (own[name] + value) / 2
        self.log_dict(
            {f"train/{name}": value for name, value in losses.items()}, batch_size=len(x_1)
        )
        return torch.stack([WEIGHTS[name] * value for name, value in losses.items()]).sum()


def distances(p: Answers, q: Answers, hidden: Tensor) -> dict[str, Tensor]:
    """KL(p || q) of candidate and log r, Laplace densities, and the mean difference of reflectance."""
    weight = hidden * p.returns.sigmoid()
    d = (p.ranges - q.ranges).abs()
    kl = p.logits - q.logits + (q.scales / p.scales).log() + d / q.scales
    kl = kl + p.scales / q.scales * (-d / p.scales).exp() - 1
    total = weight.sum().clamp(min=1)
    share = p.logits.exp()
    return {
        "range": ((share * kl).sum(1, keepdim=True) * weight).sum() / total,
        "reflectance": (
            (share * (q.strengths - p.strengths).abs()).sum(1, keepdim=True) * weight
        ).sum()
        / total,
    }


STAGES.add("learn_from_densify", LearnFromDensify)
