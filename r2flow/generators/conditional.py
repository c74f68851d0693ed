"""Generators that are told a part of the scan: rays that are known, and rays that were measured but are not trusted."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.path import expand_time
from r2flow.generators.base import Condition, Generated, Generator, Progress, Sampler
from r2flow.generators.flow import RectifiedFlow
from r2flow.lidar.interpolation import guess
from r2flow.lidar.known import Ray
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws

IMAGE, KNOWN, DOUBTFUL = "image", "known", "doubtful"
LAST = 1e-5  # of the time: where a known ray's velocity stops to grow


def condition_of(space: ModelSpace, images: Tensor, state: Tensor) -> Condition:
    """What is known of scans, as generators take it: `image`, `known` and `doubtful`, each (B, C, H, W) in model space.

    `known` is 1 where a value was measured and `doubtful` where it was measured but is not trusted; where neither
    holds, `image` has a guess (`r2flow.lidar.interpolation.guess`), and 0 where nothing at all was measured.

    Args:
        images: Range in metres and, where known, reflectance, (B, 2 or 1, H, W); 0 without a return. Of a scan without
            reflectance, that of its returns is not known; that of an empty ray is.
        state: `r2flow.lidar.known.Ray` of each ray, (B, H, W).

    Raises:
        InputError: images or states of another shape, or a ray that contradicts its state.
    """
    _, h, w = space.shape
    if images.ndim != 4 or images.shape[1] not in (1, 2) or tuple(images.shape[2:]) != (h, w):
        raise InputError(f"the images to complete must be (B, 2 or 1, {h}, {w}), found {tuple(images.shape)}.")
    if state.shape != images[:, 0].shape:
        raise InputError(f"the states of the rays must be {tuple(images[:, 0].shape)}, found {tuple(state.shape)}.")
    returned, wrong = images[:, 0] > 0, (images[:, 0] > 0) & (state == Ray.EMPTY)
    if bool(wrong.any()) or bool((~returned & (state == Ray.RETURN)).any()):
        raise InputError("a ray with a return must have a range above 0, an empty one the range 0.")
    encoding = space.encoding
    silent = encoding.reflectance and images.shape[1] == 1
    seen = state != Ray.UNKNOWN
    guesses = np.stack([guess(x, m) for x, m in zip(images.cpu().numpy(), seen.cpu().numpy(), strict=True)])
    filled = torch.where(seen[:, None], images, torch.from_numpy(guesses).to(images))
    image = encoding.encode(torch.cat([filled, torch.zeros_like(filled)], 1) if silent else filled)
    image = image * seen.flatten(1).any(1)[:, None, None, None]
    said = torch.ones_like(image)
    if silent:
        said[:, -1] = (~returned).to(said)
    measured, trusted = seen[:, None] * said, (state != Ray.DOUBTFUL)[:, None]
    return {IMAGE: image, KNOWN: measured * trusted, DOUBTFUL: measured * ~trusted}


def parts_of(condition: Condition | None, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`image`, `known` and `doubtful` of a condition, as `x` is in type and place; zeros where nothing is known.

    Raises:
        InputError: a condition of other names or shapes.
    """
    if condition is None:
        return (torch.zeros_like(x),) * 3
    if condition.keys() != {IMAGE, KNOWN, DOUBTFUL}:
        raise InputError(f"this generator is told '{IMAGE}', '{KNOWN}' and '{DOUBTFUL}', found {', '.join(condition)}.")
    image, known, doubtful = (condition[name].to(x) for name in (IMAGE, KNOWN, DOUBTFUL))
    if image.shape != x.shape or known.shape != x.shape or doubtful.shape != x.shape:
        raise InputError(f"what is known must be {tuple(x.shape)} as the scans are, found {tuple(image.shape)}.")
    return image, known, doubtful


class ConditionalFlow(RectifiedFlow):
    """v(t, x | y) of a network that also sees what is known, y: one model for any mask, none and all included.

    A known value has the exact velocity of its straight line, (y - x) / (1 - t), and arrives as it was given. The
    condition is that of `condition_of`; None draws a scan of which nothing is known.
    """

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        self.condition_channels = 3 * space.shape[0]
        super().__init__(space, backbone)

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        image, known, doubtful = parts_of(condition, x)
        v: Tensor = self.backbone(t, torch.cat([x, image, known, doubtful], dim=1))
        if condition is None:
            return v
        left = expand_time(1 - torch.as_tensor(t, device=x.device), x).clamp(min=LAST)
        return torch.where(known > 0, ((image - x) / left).to(v), v)

    def generate(
        self,
        noise: Tensor,
        condition: Condition | None = None,
        *,
        sampler: Sampler | None = None,
        draws: Draws | None = None,
        progress: Progress = None,
    ) -> Generated:
        made = super().generate(noise, condition, sampler=sampler, draws=draws, progress=progress)
        if condition is None:
            return made
        image, known, _ = parts_of(condition, made.x)
        return Generated(torch.where(known > 0, image, made.x), made.evaluations, made.converged)

    def start_from(self, parent: Generator) -> None:
        """Take over a flow's weights; those of what it was never told begin at zero and change nothing at first."""
        own, theirs = self.state_dict(), dict(parent.state_dict())
        channels, more = self.space.shape[0], self.condition_channels
        for name, value in theirs.items():
            wanted = own[name].shape if name in own else value.shape
            if value.ndim > 1 and wanted != value.shape and wanted == (len(value), value.shape[1] + more, *wanted[2:]):
                unseen = value.new_zeros(len(value), more, *value.shape[2:])
                theirs[name] = torch.cat([value[:, :channels], unseen, value[:, channels:]], dim=1)
        self._take_flow(parent, theirs)


class Regression(ConditionalFlow):
    """x_1 by one evaluation from what is known alone, whatever the noise: the opponent on mean errors.

    Learned by absolute error it is the median of each value; it draws nothing.
    """

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        super().__init__(space, backbone)
        self.sampler = Sampler("direct", 1, fixed=True)

    def estimate(self, condition: Condition | None, like: Tensor) -> Tensor:
        """x_1, (B, C, H, W), of the shape and type of `like`."""
        image, known, doubtful = parts_of(condition, like)
        t = torch.ones(len(like), device=like.device)
        told = (known + doubtful).flatten(1).any(1)[:, None, None, None]
        begun = torch.where(told, image, -1.0)  # tokens of zeros have no finite gradient in a norm
        found: Tensor = self.backbone(t, torch.cat([begun, image, known, doubtful], dim=1))
        return torch.where(known > 0, image, found)

    @torch.no_grad()
    def generate(
        self,
        noise: Tensor,
        condition: Condition | None = None,
        *,
        sampler: Sampler | None = None,
        draws: Draws | None = None,
        progress: Progress = None,
    ) -> Generated:
        found = self.estimate(condition, noise.to(self.device))
        if progress is not None:
            progress()
        return Generated.after(found, 1)

    def check_sampler(self, sampler: Sampler) -> None:
        Generator.check_sampler(self, sampler)

    def evaluations_of(self, sampler: Sampler) -> int:
        return 1

    def in_steps(self, steps: int) -> Sampler:
        return self.sampler
