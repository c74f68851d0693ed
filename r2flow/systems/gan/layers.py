"""Layers of GANs: equalised learning rate, padding, filters, ray-drop masks and latent codes."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.layers import ExactBuffers, at_least_float32, uncast, wrapped
from r2flow.base.processes import mean_over_processes

DROPPED = -1.0  # value of a dropped ray in model space
Outputs = dict[str, Tensor]  # of a network, by name
IMAGE = "image"
LOGIT = "raydrop_logit"


class Equalised(nn.Module):
    """gain rate f(x / sqrt n) with weights of N(0, 1 / rate^2), zero biases, n = weight[0].numel().

    Adam then learns all layers at equal speed, times `rate` (Karras et al. 2018, section 4.1). n is
    the fan-in, except for transposed convolutions, as in the published weights. `exact` computes in
    float32 also under autocast.
    """

    def __init__(
        self, module: Any, gain: float = 1.0, rate: float = 1.0, exact: bool = False
    ) -> None:
        super().__init__()
        self.module = module
        self.gain = gain * rate
        self.exact = exact
        self.scale = 1 / math.sqrt(module.weight[0].numel())
        nn.init.normal_(module.weight, 0, 1 / rate)
        if module.bias is not None:
            nn.init.zeros_(module.bias)

    def forward(self, x: Tensor) -> Tensor:
        if self.exact:
            return uncast(self.module, at_least_float32(x) * self.scale) * self.gain
        return self.module(x * self.scale) * self.gain


class BiasedLeakyReLU(nn.Module):
    """sqrt(2) max(x + b, 0.2 (x + b)) with a bias b per channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        bias = self.bias.to(x.dtype).view(-1, *[1] * (x.ndim - 2))
        return F.leaky_relu(x + bias, 0.2) * math.sqrt(2)


class Pad(nn.Module):
    """Padding by one pixel: circular in azimuth, by the mode `edge` in elevation."""

    def __init__(self, edge: str) -> None:
        super().__init__()
        self.edge = edge

    def forward(self, x: Tensor) -> Tensor:
        return F.pad(wrapped(x, 1, 1), (0, 0, 1, 1), mode=self.edge)


class Filter(ExactBuffers):
    """A separable filter with circular padding in azimuth ("w") and replicated edge rows ("h").

    It keeps the size. Taps are normalised to sum 1; an even number reaches one pixel further left
    and up.
    """

    def __init__(self, window: Sequence[float], axes: str = "hw") -> None:
        super().__init__()
        taps = torch.tensor(window, dtype=torch.float32)
        self.kernel = nn.Buffer(taps / taps.sum())
        self.axes = axes

    def forward(self, x: Tensor) -> Tensor:
        size = len(self.kernel)
        before = size // 2
        after = size - 1 - before
        channels = x.shape[1]
        kernel = self.kernel.to(x.dtype).expand(channels, 1, 1, -1)
        if "w" in self.axes:
            x = F.conv2d(wrapped(x, before, after), kernel, groups=channels)
        if "h" in self.axes:
            x = F.pad(x, (0, 0, before, after), mode="replicate")
            x = F.conv2d(x, kernel.mT, groups=channels)
        return x


class BlurBoth(nn.Module):
    """The image blurred in elevation and in azimuth (Kaneko and Harada 2020, NR-GAN)."""

    def __init__(self) -> None:
        super().__init__()
        self.blur_v = Filter((1, 2, 1), "h")
        self.blur_h = Filter((1, 2, 1), "w")

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([self.blur_v(x), self.blur_h(x)], dim=1)


class Heads(nn.Module):
    """A layer per output, by name."""

    def __init__(self, heads: Mapping[str, nn.Module]) -> None:
        super().__init__()
        self.heads = nn.ModuleDict(heads)

    def forward(self, *inputs: Tensor) -> Outputs:
        return {name: at_least_float32(head(*inputs)) for name, head in self.heads.items()}


def logistic(uniform: Tensor) -> Tensor:
    """Standard logistic noise log u - log(1 - u) for u in [0, 1), clamped to [eps, 1 - eps]."""
    return torch.logit(uniform, torch.finfo(torch.float32).eps)


def _straight_through_mask(logit: Tensor, noise: Tensor, temperature: float = 1.0) -> Tensor:
    """m ~ Bernoulli(sigmoid(logit)), 0 or 1, with the gradient of its relaxation s.

    s = sigmoid((logit + noise) / temperature) and m = [s > 1/2] for `logistic` noise (Maddison et
    al. 2017, appendix B; Nakashima and Kurazume 2021, eq. 4).
    """
    soft = torch.sigmoid((logit + noise) / temperature)
    return soft + ((soft > 0.5).to(soft) - soft).detach()


class RayDrop(nn.Module):
    """Set rays dropped by a random mask to -1 (Nakashima and Kurazume 2021, section III-B)."""

    def __init__(self, temperature: float) -> None:
        super().__init__()
        self.temperature = temperature
        self.raydrop_const = nn.Buffer(torch.tensor(DROPPED))

    def forward(self, made: Outputs, uniform: Tensor) -> Outputs:
        image = made[IMAGE]
        mask = _straight_through_mask(made[LOGIT], logistic(uniform), self.temperature)
        dropped = image.lerp(self.raydrop_const, 1 - mask)
        return {**made, "image_orig": image, "raydrop_mask": mask, IMAGE: dropped}


class LatentGenerator(nn.Module):
    """Generate images from z: a mapping to a code w, a synthesis and optionally a ray-drop mask.

    Parameter names are those of the published weights.

    Args:
        mapping: Maps z (B, latent) to w (B, code).
        synthesis: Maps w, optionally with angles and their rotation, to `image` and optionally
            `raydrop_logit`, (B, ., H, W) float32.
        measurement: Samples the mask; None: no mask.
        num_styles: Number of layers that take w.
    """

    decay = 0.995  # of the average w_avg

    def __init__(
        self,
        latent: int,
        code: int,
        mapping: nn.Module,
        synthesis: nn.Module,
        measurement: RayDrop | None,
        tanh: bool,
        num_styles: int = 1,
    ) -> None:
        super().__init__()
        self.latent = latent
        self.tanh = tanh
        self.num_styles = num_styles
        self.w_avg = nn.Buffer(torch.zeros(1, code))
        self.mapping_network = mapping
        self.synthesis_network = synthesis
        self.measurement_model = measurement

    def forward(
        self,
        z: Tensor,
        angle: Tensor | None = None,
        *,
        truncation: float = 1.0,
        uniform: Tensor | None = None,
        shift: Tensor | None = None,
    ) -> Outputs:
        """Generate `image` (B, C, H, W) and `w` (B, layers, code) from normal z.

        With a mask, there are also `image_orig`, `raydrop_logit` and `raydrop_mask`. In training
        mode, w_avg is updated.

        Args:
            angle: Elevation and azimuth of every pixel, (1 or B, 2, H, W), for a synthesis that
                uses them.
            truncation: psi of w <- w_avg + psi (w - w_avg), outside training (Karras et al. 2019,
                section B).
            uniform: u in [0, 1) for the noise of the mask, (B, 1, H, W).
            shift: Azimuth rotation of each scan in full turns, (B,), for a synthesis with angles.
        """
        w = self.mapping_network(z)
        if self.training:
            mean = mean_over_processes(w.detach().mean(0, keepdim=True))
            self.w_avg.lerp_(mean.to(self.w_avg), 1 - self.decay)
        elif truncation != 1:
            w = self.w_avg.lerp(w, truncation)
        rays = () if angle is None else (angle, shift)
        made = self.synthesis_network(w, *rays)
        if self.tanh:
            made[IMAGE] = made[IMAGE].tanh()
        made["w"] = w[:, None].expand(-1, self.num_styles, -1)
        if self.measurement_model is not None:
            assert uniform is not None
            made = self.measurement_model(made, uniform)
        return made
