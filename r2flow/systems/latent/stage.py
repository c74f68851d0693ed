"""Training of LiDM: an adversarial autoencoder, and the diffusion of its latents."""

from typing import Any, Unpack

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.base.processes import mean_over_processes
from r2flow.base.registry import Count, Natural, NonNegative, Options, construct
from r2flow.lidar.encoding import Encoding
from r2flow.stages.base import (
    BackboneLike,
    Batch,
    Betas,
    ModelArguments,
    SensorLike,
    SingleLoss,
    Stage,
)
from r2flow.systems.diffusion.process import noised
from r2flow.systems.latent.generator import LatentDiffusion, VQAutoencoder


class _PatchDiscriminator(nn.Module):
    """Map of scores of images (B, channels, H, W): 4 x 4 convolutions, batch norm and leaky ReLU.

    Args:
        width: Width of the first convolution; each further one doubles it, up to a factor of 8.
        layers: Number of strided convolutions.
    """

    def __init__(self, channels: Count = 1, width: Count = 64, layers: Count = 3) -> None:
        super().__init__()
        self.main = nn.Sequential(nn.Conv2d(channels, width, 4, 2, 1), nn.LeakyReLU(0.2))
        narrow = width
        for layer in range(1, layers + 1):
            wide = width * min(2**layer, 8)
            stride = 2 if layer < layers else 1
            self.main.append(nn.Conv2d(narrow, wide, 4, stride, 1, bias=False))
            self.main.append(nn.BatchNorm2d(wide))
            self.main.append(nn.LeakyReLU(0.2))
            narrow = wide
        self.main.append(nn.Conv2d(narrow, 1, 4, 1, 1))
        for module in self.main:
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, 0, 0.02)
            elif isinstance(module, nn.BatchNorm2d):
                nn.init.normal_(module.weight, 1, 0.02)

    def forward(self, x: Tensor) -> Tensor:
        return self.main(x)


def _hinge_loss(real: Tensor, fake: Tensor) -> Tensor:
    """(mean max(0, 1 - real) + mean max(0, 1 + fake)) / 2 for scores of the discriminator."""
    return (F.relu(1 - real).mean() + F.relu(1 + fake).mean()) / 2


def _adaptive_weight(
    reconstruction: Tensor, adversarial: Tensor, last: Tensor, weight: float
) -> Tensor:
    """weight |grad R| / (|grad A| + 1e-4), at most 1e4 weight.

    It balances the adversarial loss A with the reconstruction loss R at the decoder's last weights,
    with gradients averaged over all processes (Esser et al. 2021, eq. 7).
    """
    (of_r,) = torch.autograd.grad(reconstruction, last, retain_graph=True)
    (of_a,) = torch.autograd.grad(adversarial, last, retain_graph=True)
    ratio = mean_over_processes(of_r).norm() / (mean_over_processes(of_a).norm() + 1e-4)
    return weight * ratio.clamp(0, 1e4).detach()


def _reconstruction_loss(
    x: Tensor, made: Tensor, mask: Tensor | None = None, mask_factor: float = 0.0
) -> Tensor:
    """mean |x - made|; with a mask, (mean |x - made| + mask_factor mean |mask - predicted|) / 2.

    The last channel of `made` is then the predicted mask; 1 is a return, -1 a dropped ray.
    """
    channels = x.shape[1]
    error = F.l1_loss(made[:, :channels], x)
    if mask is None or not mask_factor:
        return error
    return (error + mask_factor * F.l1_loss(made[:, channels:], mask)) / 2


def _adversarial_factor(step: int, start: int, inverted: bool = False) -> float:
    """0 before step `start`, then 1; `inverted`, as in LiDM's code: 1 up to `start`, then 0."""
    return float(step <= start if inverted else step >= start)


_LEAST = 1 / 255  # metres: shorter ranges are not returns


def returns(x: Tensor, encoding: Encoding) -> Tensor:
    """Mask of images in model space, (B, 1, H, W): 1 where a range exceeds `_LEAST`, else -1."""
    # 1e-6: a range of exactly `_LEAST` is no return.
    return torch.where(encoding.format.inverse((x[:, :1] + 1 - 1e-6) / 2) < _LEAST, -1.0, 1.0)


class LearnAutoencoder(Stage):
    """Reconstruction, codebook and a patch discriminator: R + f w A + c Q for the autoencoder, f H
    for the latter.

    R is the mean absolute error, A the discriminator's verdict, w `_adaptive_weight`, Q the
    quantiser's loss, H the hinge loss and f `_adversarial_factor` (Esser et al. 2021, "Taming
    transformers").

    Args:
        discriminator: Options of `_PatchDiscriminator`: width and layers.
        adversarial_weight: In w.
        adversarial_start: Step that f changes at.
        inverted: Whether f is 1 up to that step and 0 after it, as in the published code, and not
            the other way round.
        codebook_weight: c.
        mask_factor: Weight of the mask's error, of an autoencoder with a mask.
        learning_rate: Learning rate of AdamW, constant after a linear warm-up.
    """

    learns = VQAutoencoder
    generator: VQAutoencoder
    generator_name = "vq_autoencoder"
    anneals = False

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        discriminator: Options | None = None,
        adversarial_weight: NonNegative = 0.6,
        adversarial_start: Natural = 1,
        inverted: bool = False,
        codebook_weight: NonNegative = 1.0,
        mask_factor: NonNegative = 1.0,
        learning_rate: NonNegative = 3.6e-5,
        betas: Betas = (0.5, 0.9),
        weight_decay: NonNegative = 0.0,
        muon: NonNegative | None = None,
        warmup_images: Natural = 0,
        **options: Unpack[ModelArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            learning_rate=learning_rate,
            betas=betas,
            weight_decay=weight_decay,
            muon=muon,
            warmup_images=warmup_images,
            **options,
        )
        self.automatic_optimization = False
        self.autoencoder = self.generator.first_stage_model
        channels = self.space.shape[0] + self.autoencoder.mask
        self.discriminator = construct(
            "stage.discriminator", _PatchDiscriminator, discriminator, channels
        )
        self.adversarial_weight = adversarial_weight
        self.codebook_weight = codebook_weight
        self.adversarial_start = adversarial_start
        self.inverted = inverted
        self.mask_factor = mask_factor

    def configure_optimizers(self) -> Any:
        return self.optimizers_for(self.autoencoder.parameters(), self.discriminator.parameters())

    def _mask_of(self, x: Tensor) -> Tensor | None:
        """`returns` of images, for an autoencoder with a mask."""
        return returns(x, self.generator.space.encoding) if self.autoencoder.mask else None

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        for_autoencoder, for_discriminator = self.own_optimizers()
        x = batch["x_1"]
        mask = self._mask_of(x)
        factor = _adversarial_factor(self.global_step, self.adversarial_start, self.inverted)
        made, codebook = self.autoencoder(x)
        reconstruction = _reconstruction_loss(x, made, mask, self.mask_factor)
        loss = reconstruction + self.codebook_weight * codebook
        if factor:
            adversarial = -self.discriminator(made).mean()
            last = self.autoencoder.decoder.get_parameter("conv_out.weight")
            weight = _adaptive_weight(reconstruction, adversarial, last, self.adversarial_weight)
            loss = loss + factor * weight * adversarial
        self.take_step(for_autoencoder, loss)
        real = x if mask is None else torch.cat([x, mask], 1)
        judged = _hinge_loss(self.discriminator(real), self.discriminator(made.detach()))
        self.take_step(for_discriminator, factor * judged)
        self.log("train/loss", reconstruction, prog_bar=True, sync_dist=True)
        self.log("train/codebook", codebook, sync_dist=True)
        self.log("train/discriminator", judged, sync_dist=True)

    def validation_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        x = batch["x_1"]
        made, _ = self.autoencoder(x)
        loss = _reconstruction_loss(x, made, self._mask_of(x), self.mask_factor)
        self.log_mean("val/loss", loss, batch, prog_bar=True)


class LearnLatentDiffusion(SingleLoss):
    """Mean squared error of the noise in the latents of a trained and frozen autoencoder, at steps
    drawn uniformly.

    Args:
        learning_rate: Learning rate of AdamW, constant after a linear warm-up.
    """

    learns = LatentDiffusion
    generator: LatentDiffusion
    generator_name = "latent_diffusion"
    needs_parent = True
    anneals = False

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        learning_rate: NonNegative = 1.6e-5,
        betas: Betas = (0.9, 0.999),
        weight_decay: NonNegative = 0.01,
        muon: NonNegative | None = None,
        warmup_images: Natural = 0,
        **options: Unpack[ModelArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            learning_rate=learning_rate,
            betas=betas,
            weight_decay=weight_decay,
            muon=muon,
            warmup_images=warmup_images,
            **options,
        )
        self.generator.first_stage_model.requires_grad_(False)

    def configure_optimizers(self) -> Any:
        return self.optimizers_for(self.generator.unet.parameters())

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        diffusion = self.generator
        eps = batch["x_0"]
        with torch.no_grad():
            # Full precision for small noise levels.
            z = diffusion.first_stage_model.eval().encode(batch["x_1"]).float()
        t = (u * len(diffusion.log_snr)).to(torch.int64)
        return F.mse_loss(diffusion.unet(noised(z, diffusion.log_snr[t], eps), t), eps)
