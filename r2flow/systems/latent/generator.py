"""Latent-space generators: LiDM's autoencoder, and the diffusion of its latents."""

from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn

from r2flow.base.errors import InputError
from r2flow.base.registry import Count, Options, construct
from r2flow.generators.base import Generator
from r2flow.lidar.encoding import ModelSpace
from r2flow.samplers.base import Generated, Known, Noise, Sampler, Tick, last_of
from r2flow.systems.diffusion.generator import DDIM, Share
from r2flow.systems.diffusion.process import PREDICTIONS, walk
from r2flow.systems.diffusion.schedules import DISCRETE
from r2flow.systems.latent.autoencoder import Autoencoder
from r2flow.systems.latent.unet import LatentUNet


class _Latent(Generator):
    """A generator with an autoencoder, whose noise has the shape of the latents."""

    def __init__(
        self, space: ModelSpace, backbone: Options | None, autoencoder: Options | None = None
    ) -> None:
        super().__init__(space)
        self.first_stage_model = construct(
            "generator.autoencoder", Autoencoder, autoencoder, space.shape[0]
        )
        self.noise_shape = self.first_stage_model.latent_shape(*space.shape[1:])


class VQAutoencoder(_Latent):
    """An autoencoder, the first stage of a `LatentDiffusion`. It cannot sample scans from noise.

    Args:
        autoencoder: Options of `r2flow.systems.latent.autoencoder.Autoencoder`.
    """

    unconditional = False


class LatentDiffusion(_Latent):
    """eps(z_t, t) by a U-Net on an autoencoder's latents, sampled by DDIM and decoded.

    LiDM (Ran et al. 2024). Latents become codes when they are decoded, not before. Its sampler is
    `LatentDDIM`.

    Args:
        autoencoder: Options of `r2flow.systems.latent.autoencoder.Autoencoder`.
        unet: Options of `r2flow.systems.latent.unet.LatentUNet`; `position: learnable` is
            LiDM + APE.
        schedule: Name and options of a schedule of N steps in
            `r2flow.systems.diffusion.schedules.DISCRETE`.
    """

    def __init__(
        self,
        space: ModelSpace,
        backbone: Options | None,
        autoencoder: Options | None = None,
        unet: Options | None = None,
        schedule: Options | None = None,
    ) -> None:
        super().__init__(space, backbone, autoencoder)
        self.run_by(LatentDDIM())
        with torch.device("cpu"):
            log_snr = DISCRETE.build(schedule or {"name": "square_root_linear"})
        network = construct("generator.unet", LatentUNet, unet, self.noise_shape)
        self.model = nn.ModuleDict({"diffusion_model": network})
        self.log_snr = nn.Buffer(log_snr.float(), persistent=False)

    @property
    def unet(self) -> LatentUNet:
        """The network eps(z, t)."""
        return cast(LatentUNet, self.model["diffusion_model"])

    def expected(self, z: Tensor, t: Tensor) -> Tensor:
        """Expected latents given z (B, ...) at step t, ()."""
        eps = self.unet(z, t.to(z.device).expand(len(z)))
        return PREDICTIONS["eps"].split(z, eps, self.log_snr[t])[0]

    def start_from(self, parent: Generator) -> None:
        """Load the weights of an autoencoder or another latent diffusion."""
        new = self.state_dict() if isinstance(parent, VQAutoencoder) else {}
        self._take(parent, {**new, **parent.state_dict()})


@dataclass(frozen=True)
class LatentDDIM(Sampler):
    """DDIM on every (N // steps)-th of the diffusion's N steps, then the decoder.

    The last step goes to lambda_0 and not to the data, as in the published code, and adds noise
    too.
    """

    paired = False
    draws = DDIM.draws
    needs = "unet"

    steps: Count = 50
    eta: Share = 1.0  # share of fresh noise

    def evaluations(self, generator: Any) -> int:
        return len(_some_of(len(generator.log_snr), self.steps))

    def check(self, generator: Any) -> None:
        super().check(generator)
        self.evaluations(generator)

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        times = _some_of(len(generator.log_snr), self.steps)
        log_snrs = generator.log_snr[[*times.tolist(), 0]]
        z = last_of(walk(generator.expected, noise, log_snrs, self.eta, draws, times), progress)
        # Its output is the scan, without later corrections.
        with torch.autocast(z.device.type, enabled=False):
            scans = generator.first_stage_model.decode(z)
        return Generated.after(scans, len(times))


def _some_of(total: int, steps: int) -> Tensor:
    """Every (total // steps)-th number below total from 1, decreasing.

    There are more than `steps` if it does not divide the total.
    """
    if not 1 <= steps < total:
        raise InputError(
            f"a diffusion of {total} steps is sampled in 1 to {total - 1}, found {steps}."
        )
    return torch.arange(1, total, total // steps, device="cpu").flip(0)
