"""A flow that completes scans: it is told some rays of an image and draws the others."""

import torch

from r2flow.base import noise
from r2flow.generators import GENERATORS, RectifiedFlow
from r2flow.stages import STAGES, Rectify


class Completion(RectifiedFlow):
    """v(t, x) of a network that also sees the known rays, `image` (B, C, H, W), and `mask` (B, 1,
    H, W), 1 where known.

    A generated scan has the known rays as they were given.
    """

    @property
    def condition_channels(self):
        return self.space.shape[0] + 1

    def velocity(self, t, x, condition=None):
        known = condition or {"image": torch.zeros_like(x), "mask": torch.zeros_like(x[:, :1])}
        image, mask = (known[name].to(x) for name in ("image", "mask"))
        return self.backbone(t, torch.cat([x, image * mask, mask], dim=1))

    takes_condition = True

    def forward(self, noise, condition=None, **options):
        made = super().forward(noise, condition, **options)
        if condition:
            made.x.copy_(
                torch.where(condition["mask"].to(made.x) > 0, condition["image"].to(made.x), made.x)
            )
        return made


class LearnCompletion(Rectify):
    """A share of the rows of image k is known; the share and the rows are functions of (seed, k)."""

    generator_name = "toy_completion"

    def condition(self, batch):
        draws = [noise.generator(self.seed, "condition", int(k)) for k in batch["k"]]
        rows = [
            torch.from_numpy(draw.random(batch["x_1"].shape[-2]) < draw.random()) for draw in draws
        ]
        mask = torch.stack(rows)[:, None, :, None].to(batch["x_1"]).expand_as(batch["x_1"][:, :1])
        return {"image": batch["x_1"], "mask": mask}


GENERATORS.add("toy_completion", Completion)
STAGES.add("toy_completion", LearnCompletion)
