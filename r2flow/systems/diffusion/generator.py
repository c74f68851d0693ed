"""A diffusion: a network that predicts noise or data, sampled step by step or as the flow that it also is."""

from collections.abc import Mapping
from itertools import count
from typing import Any

import torch
from torch import Tensor

from r2flow.backbones import Pyramid
from r2flow.errors import InputError
from r2flow.flow.solvers import Solution
from r2flow.flow.solvers.solution import finite, wide
from r2flow.generators.base import Condition, Generated, Progress, Sampler
from r2flow.generators.flow import UNTOLD, NetworkFlow
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws
from r2flow.registry import Positive
from r2flow.systems.diffusion.log_snr import SCHEDULES, alpha_sigma, for_images, log_snr_of, straight_time
from r2flow.systems.diffusion.objectives import PREDICTIONS
from r2flow.systems.diffusion.sampling import DDIM, DDPM, eta_of, walk


class Diffusion(NetworkFlow):
    """y(z_t, lambda_t) by a backbone whose time is the log-SNR lambda, as R2DM (Nakashima and Kurazume 2024).

    Samplers beside a flow's solvers:

    - `ddpm`: ancestral steps;
    - `ddim`, `ddim:ETA`: without new noise, or with the share ETA of it.

    As a flow it follows the diffusion's probability-flow ODE along straight lines: a line's state x_s = s x_1 +
    (1 - s) x_0 is z_t / (alpha_t + sigma_t) at the t where alpha_t / (alpha_t + sigma_t) = s, so that

        v(s, x_s) = x(z_t, lambda_t) - eps(z_t, lambda_t).

    Nearer to an end than the schedule goes, lambda stays at that end.

    Args:
        space: The images it makes.
        backbone: Name and options, as in conf/backbone.
        prediction: What y is, a name in `r2flow.systems.diffusion.objectives.PREDICTIONS`.
        schedule: Name and options of a log-SNR schedule in `r2flow.systems.diffusion.log_snr.SCHEDULES`.
        clip: Expected data are clamped to [-clip, clip] whenever scans are made; null leaves them as they are.
    """

    other_samplers = DDPM, f"{DDIM}:ETA", *NetworkFlow.other_samplers

    def __init__(
        self,
        space: ModelSpace,
        backbone: Mapping[str, Any],
        prediction: str = "eps",
        schedule: Mapping[str, Any] | None = None,
        clip: Positive | None = 1.0,
    ) -> None:
        super().__init__(space, backbone)
        if isinstance(self.backbone, Pyramid):
            raise InputError("a pyramid needs the time of straight lines, and a diffusion has another: choose hdit.")
        self.prediction, self.clip, self.answer = PREDICTIONS[prediction], clip, f"{prediction}(z, log-SNR)"
        self.schedule = SCHEDULES.build(schedule or {"name": "cosine"})
        self.sampler = Sampler(DDPM, 256)  # as the published scripts
        ends = torch.tensor([1.0, 0.0], dtype=torch.float64, device="cpu")  # numbers, also under the meta device
        self._ends = straight_time(self.schedule(ends)).tolist()

    def predict(self, z: Tensor, log_snr: Tensor) -> Tensor:
        """y, (B, C, H, W), of states z and log-SNRs of shape () or (B,)."""
        y: Tensor = self.backbone(log_snr.float(), z)
        return y

    def denoise(self, z: Tensor, log_snr: Tensor) -> Tensor:
        """The data that are expected behind z, clamped."""
        x, _ = self.prediction.split(z, self.predict(z, log_snr), log_snr)
        return x if self.clip is None else x.clamp(-self.clip, self.clip) + 0 * x  # NaN of what is not finite

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        if condition is not None:
            raise InputError(UNTOLD)
        log_snr = log_snr_of(torch.as_tensor(t, device=x.device).clamp(*self._ends))
        alpha, sigma = alpha_sigma(for_images(log_snr, x))
        z = (alpha + sigma) * x
        clean = self.denoise(z, log_snr)
        return clean - (z - alpha * clean) / sigma

    @torch.no_grad()
    def solve(
        self, x: Tensor, t_0: float = 0.0, t_1: float = 1.0, *, sampler: Sampler | None = None, **options: Any
    ) -> Solution:
        how = sampler or self.sampler
        if eta_of(how.method) is not None:
            raise InputError(f"{how.method} goes from noise to data alone: give a flow's solver, as --solver adams3.")
        return super().solve(x, t_0, t_1, sampler=how, **options)

    def generate(
        self,
        noise: Tensor,
        condition: Condition | None = None,
        *,
        sampler: Sampler | None = None,
        draws: Draws | None = None,
        progress: Progress = None,
    ) -> Generated:
        how = sampler or self.sampler
        eta = eta_of(how.method)
        if eta is None:
            return super().generate(noise, condition, sampler=how, draws=draws, progress=progress)
        if condition is not None:
            raise InputError(UNTOLD)
        if eta and draws is None:
            raise InputError(f"{how.method} draws further noise: give draws.")
        z, steps = wide(noise.to(self.device)), count(1)

        def drawn() -> Tensor:
            assert draws is not None
            return self.further_noise(draws, next(steps)).to(z)

        with torch.no_grad():
            for following in walk(self.denoise, z, self._log_snrs(how).to(z), eta, drawn):
                z = following
                if progress is not None:
                    progress()
        return Generated.after(z if self.clip is None else z.clamp(-self.clip, self.clip), how.steps, finite(z))

    def _log_snrs(self, how: Sampler) -> Tensor:
        """Of the sampler's grid, whose times run from noise to data, (N + 1,) float64."""
        log_snrs: Tensor = self.schedule(1 - self._times(how))
        return log_snrs

    def check_sampler(self, sampler: Sampler) -> None:
        if eta_of(sampler.method) is None:
            try:
                super().check_sampler(sampler)
            except InputError as error:
                raise InputError(f"a diffusion has ddpm, ddim:ETA and a flow's solvers: {error}") from None
            return
        if sampler.finish:
            raise InputError(f"{sampler.method} has no finish; leave it out, or give a solver.")
        self._log_snrs(sampler)

    def draws_noise(self, sampler: Sampler) -> bool:
        return bool(eta_of(sampler.method)) or super().draws_noise(sampler)

    def evaluations_of(self, sampler: Sampler) -> int:
        return super().evaluations_of(sampler) if eta_of(sampler.method) is None else sampler.steps

    def in_steps(self, steps: int) -> Sampler:
        return Sampler(DDPM if eta_of(self.sampler.method) is None else self.sampler.method, steps)
