"""Training of LiDM: an adversarial autoencoder, and the diffusion of its latents."""

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from r2flow.errors import InputError
from r2flow.generators import Generator
from r2flow.lidar.encoding import Encoding, ShiftedLog
from r2flow.registry import Natural, NonNegative, construct
from r2flow.stages.base import Batch, SingleLoss, Stage
from r2flow.systems.diffusion.sampling import noised
from r2flow.systems.latent.discriminator import (
    PatchDiscriminator,
    adaptive_weight,
    adversarial_factor,
    hinge_loss,
    reconstruction_loss,
)
from r2flow.systems.latent.generator import LatentDiffusion, VQAutoencoder

LEAST = 1 / 255  # metres: shorter ranges are not returns
SHIFT = 1e-4  # metres; added by `ShiftedLog`, missing in the published threshold


def returns(x: Tensor, encoding: Encoding) -> Tensor:
    """Mask of returns of images in model space, 1 or -1, (B, 1, H, W)."""
    metres = LEAST - SHIFT if isinstance(encoding.format, ShiftedLog) else LEAST
    least = encoding.format.forward(torch.full((1, 1, 1), metres, device=x.device))
    return torch.where(x[:, :1] < 2 * least - 1 + 1e-6, -1.0, 1.0)


class LearnAutoencoder(Stage):
    """Reconstruction, codebook and a patch discriminator: R + f w A + c Q for the autoencoder, f H for the latter.

    R is the mean absolute error, A the discriminator's verdict, w `adaptive_weight`, Q the quantiser's loss, H the
    hinge loss and f `adversarial_factor`, all of `r2flow.systems.latent.discriminator` (Esser et al. 2021).

    Args:
        discriminator: Options of `PatchDiscriminator`: width and layers.
        adversarial_weight: In w.
        adversarial_start: Step that f changes at.
        inverted: Whether f is 1 up to that step and 0 after it, as in the published code, and not the other way round.
        codebook_weight: c.
        mask_factor: Weight of the mask's error, of an autoencoder with a mask.
        options: Those of `Stage`. The learning rate does not fall.
    """

    learns = VQAutoencoder
    generator: VQAutoencoder
    generator_name = "vq_autoencoder"
    anneals = False

    def __init__(
        self,
        generator: Generator,
        discriminator: Mapping[str, Any] | None = None,
        adversarial_weight: NonNegative = 0.6,
        adversarial_start: Natural = 1,
        inverted: bool = False,
        codebook_weight: NonNegative = 1.0,
        mask_factor: NonNegative = 1.0,
        **options: Any,
    ) -> None:
        super().__init__(generator, **options)
        self.automatic_optimization = False
        self.autoencoder = self.generator.first_stage_model
        channels = generator.space.shape[0] + self.autoencoder.mask
        self.discriminator = construct("stage.discriminator", PatchDiscriminator, discriminator, channels)
        rows, columns = generator.space.shape[1:]
        if min(rows, columns) < self.discriminator.smallest:
            raise InputError(
                f"stage.discriminator judges images of at least {self.discriminator.smallest} rows and columns, found "
                f"{rows} x {columns}; give it fewer layers, as stage.discriminator='{{layers: 1}}'."
            )
        self.adversarial_weight, self.codebook_weight = adversarial_weight, codebook_weight
        self.adversarial_start, self.inverted = adversarial_start, inverted
        self.mask_factor = mask_factor

    def configure_optimizers(self) -> Any:
        return self.optimizers_for(self.autoencoder.parameters(), self.discriminator.parameters())

    def mask_of(self, x: Tensor) -> Tensor | None:
        """`returns` of images, for an autoencoder with a mask."""
        return returns(x, self.generator.space.encoding) if self.autoencoder.mask else None

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        for_autoencoder, for_discriminator = self.own_optimizers()
        x = batch["x_1"]
        mask = self.mask_of(x)
        factor = adversarial_factor(self.global_step, self.adversarial_start, self.inverted)
        made, quantised = self.autoencoder(x)
        reconstruction = reconstruction_loss(x, made, mask, self.mask_factor)
        loss = reconstruction + self.codebook_weight * quantised.loss
        if factor:
            adversarial = -self.discriminator(made).mean()
            last = self.autoencoder.decoder.get_parameter("conv_out.weight")
            weight = adaptive_weight(reconstruction, adversarial, last, self.adversarial_weight)
            loss = loss + factor * weight * adversarial
        self.take_step(for_autoencoder, loss)
        real = x if mask is None else torch.cat([x, mask], 1)
        judged = hinge_loss(self.discriminator(real), self.discriminator(made.detach()))
        self.take_step(for_discriminator, factor * judged)
        self.log("train/loss", reconstruction, prog_bar=True, sync_dist=True)
        self.log("train/codebook", quantised.loss, sync_dist=True)
        self.log("train/discriminator", judged, sync_dist=True)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        x = batch["x_1"]
        loss = reconstruction_loss(x, self.autoencoder(x)[0], self.mask_of(x), self.mask_factor)
        self.log("val/loss", loss, prog_bar=True, batch_size=len(x), sync_dist=True)


class LearnLatentDiffusion(SingleLoss):
    """Mean squared error of the noise in a trained autoencoder's latents, at steps drawn uniformly.

    Args:
        generator: A `LatentDiffusion`, whose autoencoder is frozen.
        options: Those of `Stage`. The learning rate does not fall.
    """

    learns = LatentDiffusion
    generator: LatentDiffusion
    generator_name = "latent_diffusion"
    needs_parent = True
    anneals = False

    def __init__(self, generator: Generator, **options: Any) -> None:
        super().__init__(generator, **options)
        generator.first_stage_model.requires_grad_(False)

    def configure_optimizers(self) -> Any:
        return self.optimizers_for(self.generator.unet.parameters())

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        """Mean loss over images at the steps selected by u in [0, 1), (B,)."""
        diffusion, eps = self.generator, batch["x_0"]
        with torch.no_grad():
            z = diffusion.first_stage_model.eval().encode(batch["x_1"]).float()  # full precision for small noise levels
        t = (u * len(diffusion.log_snr)).to(torch.int64)
        return F.mse_loss(diffusion.unet(noised(z, diffusion.log_snr[t], eps), t), eps)
