"""A rectified flow of what a sensor makes of a place: ray-drop and reflectance, for a given geometry."""

from collections.abc import Mapping
from statistics import NormalDist
from typing import Any

import torch
from torch import Tensor

from r2flow.backbones import build_backbone
from r2flow.errors import InputError
from r2flow.generators.base import Condition, Generated
from r2flow.generators.flow import Flow
from r2flow.generators.transfer import Candidates, RowFeatures, steps_of
from r2flow.lidar.space import ModelSpace
from r2flow.samplers import FixedSteps

UPRIGHT, LEVEL = 8, 24  # rows and columns: a hole that is narrower in one of them is no sky
ROUGH = 0.02  # noise on log r, beyond which a filled hole looks as its surroundings do
FEATURES = 2 + 8  # of a geometry
DROPPED = -1.0  # the first channel of a ray that does not return; 1 of one that does


class SensorFlow(Flow):
    """v(t, x | geometry) of x = (return, reflectance), (B, 2, H, W), between -1 and 1.

    It learns from real scans alone. The geometry of a scan is its returns with the holes between them filled from the
    neighbours; sky stays empty. So that a filled hole cannot be told from a return, a share of the returns is filled
    as well, and all ranges are seen under 2 % of noise.
    """

    told, draws = True, False

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        if not space.encoding.reflectance:
            raise InputError("a sensor's ray-drop and reflectance are learned from scans with reflectance.")
        super().__init__(space, (2, *space.shape[1:]))
        self.rows = RowFeatures(space.rays[0, :, 0])
        self.backbone = build_backbone(backbone, space.rays, 2 + FEATURES + RowFeatures.FEATURES, 2)
        self.run_by(FixedSteps(method="heun2", steps=6))

    def geometry(
        self, images: Tensor, hidden: Tensor, noise: Tensor, ring: bool = True
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The surfaces of scans, as the network sees them.

        Args:
            images: Range in metres, (B, 1 or more, H, W); 0 without a return.
            hidden: Returns that are filled as holes are, (B, 1, H, W) bool.
            noise: N(0, 1), (B, 1, H, W).
            ring: Whether the columns are a full turn.

        Returns:
            Features, (B, `FEATURES`, H, W); rays that meet a surface, (B, 1, H, W) bool; log r, measured or filled.
        """
        r = images[:, :1]
        returned = r > 0
        left = returned & ~hidden
        log_r = torch.where(returned, r, 1.0).log()
        elevations = self.space.rays[0, :, 0].to(r)[None].expand(len(r), -1)
        steps = steps_of(elevations, torch.pi * 2 / self.space.shape[2])
        about = Candidates.of(log_r, torch.zeros_like(r), left, steps, ring)
        apart, beside = about.down.abs(), about.aside.abs()
        upright = (apart[:, :2].sum(1, keepdim=True) <= UPRIGHT) & (beside[:, :2].amax(1, keepdim=True) <= 1)
        level = (beside[:, 2:].sum(1, keepdim=True) <= LEVEL) & (apart[:, 2:].amax(1, keepdim=True) <= 1)
        narrow = (about.there[:, 4:5] & upright) | (about.there[:, 5:] & level)
        surface = left | narrow
        seen = torch.where(left, log_r, about.guess) + ROUGH * noise
        around = torch.cat([seen, surface.to(seen)], 1)
        moved = [around.roll(by, dim) for dim, by in ((3, 1), (3, -1), (2, 1), (2, -1))]
        slopes = [((other[:, :1] - seen) * other[:, 1:] * surface).clamp(-1, 1) for other in moved]
        features = torch.cat([(seen / 3 - 1) * surface, surface, *slopes, *(other[:, 1:] for other in moved)], 1)
        return features, surface, torch.where(returned, log_r, about.guess)

    def condition(self, features: Tensor) -> Condition:
        """Features of `geometry` with those of the rows, as the velocity takes them; columns may be a part."""
        elevations = self.space.rays[0, :, 0].to(features)[None].expand(len(features), -1)
        rows = self.rows(elevations, steps_of(elevations, torch.pi * 2 / self.space.shape[2]))
        return {"geometry": torch.cat([features, rows.expand(-1, -1, -1, features.shape[3])], 1)}

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        assert condition is not None
        v: Tensor = self.backbone(t, torch.cat([x, condition["geometry"].to(x)], 1))
        return v

    def forward(self, noise: Tensor, condition: Condition | None = None, **how: Any) -> Generated:
        if condition is None or "geometry" not in condition:
            raise InputError("a sensor flow draws ray-drop and reflectance for a geometry: r2flow translate.")
        return super().forward(noise, condition, **how)


def target_of(images: Tensor) -> Tensor:
    """x_1 of scans in metres and reflectance, (B, 2, H, W): return and reflectance of [-1, 1]; 0 where unknown."""
    returned = images[:, :1] > 0
    return torch.cat([torch.where(returned, 1.0, DROPPED), (2 * images[:, 1:2] - 1) * returned], 1)


def hidden_returns(noise: Tensor, share: float) -> Tensor:
    """Rays of which a share is hidden, half of them one by one and half in blobs, by N(0, 1) of (B, 2, H, W)."""
    hidden = noise < NormalDist().inv_cdf(max(share, 1e-6) / 2)
    rows, columns = noise.shape[2:]
    blobs = hidden[:, 1:, ::3, ::6].repeat_interleave(3, 2).repeat_interleave(6, 3)[:, :, :rows, :columns]
    return hidden[:, :1] | blobs
