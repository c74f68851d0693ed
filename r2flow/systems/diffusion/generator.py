"""Diffusion models: a network that predicts noise or data, sampled by diffusion or as a flow."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from r2flow.base.registry import Options, Positive, Share
from r2flow.flow.solvers.solution import finite
from r2flow.generators.flow import NetworkFlow
from r2flow.lidar.encoding import ModelSpace
from r2flow.samplers import MMPS, Repaint
from r2flow.samplers.base import (
    Condition,
    Generated,
    Known,
    Noise,
    OnGrid,
    Steps,
    Tick,
    last_of,
)
from r2flow.systems.diffusion.process import (
    PREDICTIONS,
    alpha_sigma,
    for_images,
    repaint,
    walk,
)
from r2flow.systems.diffusion.schedules import SCHEDULES


class Diffusion(NetworkFlow):
    """y(z_t, lambda_t) by a backbone with the log-SNR lambda as time, as in R2DM.

    Nakashima and Kurazume 2024. Samplers: `DDPM`, `DDIM` and those of flows; `Repaint` completes
    scans by ancestral steps.

    The flow is the diffusion's probability-flow ODE on straight lines: a line's state
    x_s = s x_1 + (1 - s) x_0 is z_t / (alpha_t + sigma_t) at the t with
    alpha_t / (alpha_t + sigma_t) = sigmoid(lambda_t / 2) = s, so that

        v(s, x_s) = x(z_t, lambda_t) - eps(z_t, lambda_t).

    Beyond the ends of the schedule, lambda is constant.

    Args:
        backbone: Name and options, as in conf/backbone.
        prediction: Meaning of y, a name in `r2flow.systems.diffusion.process.PREDICTIONS`.
        schedule: Name and options of a log-SNR schedule in
            `r2flow.systems.diffusion.schedules.SCHEDULES`.
        clip: Clamp expected data to [-clip, clip] in sampling; null: no clamping.
    """

    # Repaint as in the published script.
    completers = (MMPS(), Repaint(steps=32, grid="uniform", repeats=16))

    def __init__(
        self,
        space: ModelSpace,
        backbone: Options,
        prediction: str = "eps",
        schedule: Options | None = None,
        clip: Positive | None = 1.0,
    ) -> None:
        super().__init__(space, backbone)
        self.backbone.refuse_parametrised(type(self).__name__)
        self.prediction = PREDICTIONS[prediction]
        self.clip = clip
        self.answer = f"{prediction}(z, log-SNR)"
        self.schedule = SCHEDULES.build(schedule or {"name": "cosine"})
        self.run_by(DDPM(256))  # as in the published scripts
        # Real values, also under the meta device.
        ends = torch.tensor([1.0, 0.0], dtype=torch.float64, device="cpu")
        self._ends = torch.sigmoid(self.schedule(ends) / 2).tolist()

    def predict(self, z: Tensor, log_snr: Tensor) -> Tensor:
        """y, (B, C, H, W), of states z and log-SNRs of shape () or (B,)."""
        return self.backbone(log_snr, z)

    def denoise(self, z: Tensor, log_snr: Tensor) -> Tensor:
        """Expected data given z, clamped."""
        x, _ = self.prediction.split(z, self.predict(z, log_snr), log_snr)
        return self._clipped(x) + 0 * x  # keeps NaN

    def _clipped(self, x: Tensor) -> Tensor:
        return x if self.clip is None else x.clamp(-self.clip, self.clip)

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        log_snr = 2 * torch.logit(torch.as_tensor(t, device=x.device).clamp(*self._ends))
        alpha, sigma = alpha_sigma(for_images(log_snr, x))
        z = (alpha + sigma) * x
        clean = self.denoise(z, log_snr)
        return clean - (z - alpha * clean) / sigma

    def log_snrs(self, how: OnGrid, z: Tensor) -> Tensor:
        """The schedule at a sampler's times, rising.

        It is rounded as in training: at the ends of time, x shows the digits of lambda.
        """
        return self.schedule((1 - how.times()).to(z))

    def repaint(
        self,
        how: Repaint,
        z: Tensor,
        image: Tensor,
        known: Tensor,
        noise: Noise,
        progress: Tick,
    ) -> Tensor:
        """Sample x_1 from noise z given the known part of an image, by the published RePaint."""

        def denoise(z: Tensor, log_snr: Tensor) -> Tensor:
            progress()
            return self.denoise(z, log_snr)

        log_snrs = self.log_snrs(how, z)
        states = repaint(denoise, z, image, known, log_snrs, noise, how.repeats, how.jump)
        *_, completed = states
        return self._clipped(completed)


@dataclass(frozen=True)
class DDIM(OnGrid):
    """DDIM steps along the schedule (Song et al. 2021)."""

    paired = False
    needs = "denoise"

    steps: Steps = 256
    eta: Share = 0.0  # share of fresh noise; 0: deterministic, 1: ancestral steps

    @property
    def draws(self) -> bool:  # type: ignore[override]
        return self.eta > 0

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        log_snrs = generator.log_snrs(self, noise)
        z = last_of(walk(generator.denoise, noise, log_snrs, self.eta, draws), progress)
        return Generated.after(generator._clipped(z), self.steps, finite(z))


@dataclass(frozen=True)
class DDPM(DDIM):
    """Ancestral steps."""

    eta: Share = 1.0
