"""Patch discriminator and reconstruction losses (Esser et al. 2021, "Taming transformers")."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.processes import averaged
from r2flow.registry import Count


class PatchDiscriminator(nn.Module):
    """Map of scores of images (B, channels, H, W): 4 x 4 convolutions, batch norm and leaky ReLU.

    Args:
        width: Width of the first convolution; each further one doubles it, up to a factor of 8.
        layers: Number of strided convolutions.
    """

    def __init__(self, channels: Count = 1, width: Count = 64, layers: Count = 3) -> None:
        super().__init__()
        self.smallest = 3 * 2**layers  # rows, columns: after `layers` halvings, two 4 x 4 convolutions without stride
        parts: list[nn.Module] = [nn.Conv2d(channels, width, 4, 2, 1), nn.LeakyReLU(0.2)]
        narrow = width
        for layer in range(1, layers + 1):
            wide = width * min(2**layer, 8)
            stride = 2 if layer < layers else 1
            parts += [
                nn.Conv2d(narrow, wide, 4, stride, 1, bias=False), nn.BatchNorm2d(wide), nn.LeakyReLU(0.2),
            ]  # fmt: skip
            narrow = wide
        self.main = nn.Sequential(*parts, nn.Conv2d(narrow, 1, 4, 1, 1))
        for module in self.main:
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, 0, 0.02)
            elif isinstance(module, nn.BatchNorm2d):
                nn.init.normal_(module.weight, 1, 0.02)

    def forward(self, x: Tensor) -> Tensor:
        return self.main(x)


def hinge_loss(real: Tensor, fake: Tensor) -> Tensor:
    """(mean max(0, 1 - real) + mean max(0, 1 + fake)) / 2 for scores of the discriminator."""
    return (F.relu(1 - real).mean() + F.relu(1 + fake).mean()) / 2


def adaptive_weight(reconstruction: Tensor, adversarial: Tensor, last: Tensor, weight: float) -> Tensor:
    """weight |grad R| / (|grad A| + 1e-4), at most 1e4 weight: balances the adversarial loss A with the reconstruction
    loss R at the decoder's last weights, with gradients averaged over all processes (eq. 7).
    """
    grad_r, grad_a = (
        averaged(torch.autograd.grad(loss, last, retain_graph=True)[0]).norm() for loss in (reconstruction, adversarial)
    )
    return weight * (grad_r / (grad_a + 1e-4)).clamp(0, 1e4).detach()


def reconstruction_loss(x: Tensor, made: Tensor, mask: Tensor | None = None, mask_factor: float = 0.0) -> Tensor:
    """mean |x - made|; with a mask, (mean |x - made| + mask_factor mean |mask - predicted mask|) / 2.

    The last channel of `made` is then the predicted mask; 1 is a return, -1 a dropped ray.
    """
    error = (x - made[:, : x.shape[1]]).abs().mean()
    if mask is None or not mask_factor:
        return error
    return (error + mask_factor * (mask - made[:, x.shape[1] :]).abs().mean()) / 2


def adversarial_factor(step: int, start: int, inverted: bool = False) -> float:
    """0 before step `start`, then 1; `inverted`, as in LiDM's published code: 1 up to `start`, then 0."""
    return float(step <= start if inverted else step >= start)
