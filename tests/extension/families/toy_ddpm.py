"""A DDPM: a network learns the noise in x_t = sqrt(a) x_1 + sqrt(1 - a) x_0, and generating takes it out in steps.

Time runs as everywhere here, from noise at t = 0 to data at t = 1, with a(t) = sin(pi t / 2)^2 (Nichol and Dhariwal
2021, eq. 17). Ho et al. 2020 for `ddpm`, Song et al. 2021, eq. 12 and 16, for both.
"""

from math import pi

import torch

from r2flow.backbones import build_backbone
from r2flow.errors import InputError
from r2flow.generators import GENERATORS, Generated, Generator, Sampler
from r2flow.stages import STAGES, Stage


def signal(t):
    """a(t), the share of the data in the variance, (B, 1, 1, 1) or ()."""
    return torch.sin(torch.as_tensor(t) * pi / 2).square().clamp(min=1e-4)


class ToyDDPM(Generator):
    def __init__(self, space, backbone):
        super().__init__(space)
        self.sampler = Sampler("ddpm", steps=32)
        self.backbone = build_backbone(backbone, space.rays, space.shape[0])

    def generate(self, noise, condition=None, *, sampler=None, draws=None, progress=None):
        how, x = sampler or self.sampler, noise
        for j in range(how.steps):
            a, b = signal(j / how.steps), signal((j + 1) / how.steps)
            x_1 = ((x - (1 - a).sqrt() * self.backbone(j / how.steps, x)) / a.sqrt()).clamp(-1, 1)
            direction = (x - a.sqrt() * x_1) / (1 - a).sqrt()
            sigma = ((1 - b) / (1 - a) * (1 - a / b)).sqrt() if how.method == "ddpm" else torch.zeros(())
            x = b.sqrt() * x_1 + (1 - b - sigma**2).clamp(min=0).sqrt() * direction
            if sigma > 0:
                x = x + sigma * draws.step(self.noise_shape, j + 1).to(x)
            if progress:
                progress()
        return Generated.after(x, evaluations=how.steps)

    def check_sampler(self, sampler):
        if sampler.method not in ("ddpm", "ddim") or sampler.grid != "uniform":
            raise InputError(f"a DDPM is sampled by ddpm or ddim in equal steps, found {sampler.method!r}.")


class LearnNoise(Stage):
    generator_name = "toy_ddpm"

    def loss(self, batch, u):
        a = signal(u[:, None, None, None])
        x_t = a.sqrt() * batch["x_1"] + (1 - a).sqrt() * batch["x_0"]
        return (self.generator.backbone(u, x_t) - batch["x_0"]).square().mean()

    def training_step(self, batch, batch_idx):
        loss = self.loss(batch, batch["u"])
        self.log("train/loss", loss)
        return loss

    def validation_step(self, batch, batch_idx):
        self.log("val/loss", self.loss(batch, batch["u"]), batch_size=len(batch["k"]))


GENERATORS.add("toy_ddpm", ToyDDPM)
STAGES.add("toy_ddpm", LearnNoise)
