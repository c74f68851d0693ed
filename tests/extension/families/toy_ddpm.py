"""A DDPM: a network learns the noise in x_t = sqrt(a) x_1 + sqrt(1 - a) x_0, and generating takes it out in steps.

Time runs as everywhere here, from noise at t = 0 to data at t = 1, with a(t) = sin(pi t / 2)^2 (Nichol and Dhariwal
2021, eq. 17). Steps are ancestral (Song et al. 2021, eq. 12 and 16).
"""

from dataclasses import dataclass
from math import pi

import torch

from r2flow.backbones import build_backbone
from r2flow.generators import GENERATORS, Generated, Generator
from r2flow.samplers import SAMPLERS, Sampler
from r2flow.stages import STAGES, Stage


def signal(t):
    """a(t), the share of the data in the variance, (B, 1, 1, 1) or ()."""
    return torch.sin(torch.as_tensor(t) * pi / 2).square().clamp(min=1e-4)


class ToyDDPM(Generator):
    def __init__(self, space, backbone):
        super().__init__(space)
        self.run_by(ToySteps())
        self.backbone = build_backbone(backbone, space.rays, space.shape[0])


@dataclass(frozen=True)
class ToySteps(Sampler):
    needs = "backbone"

    steps: int = 32
    draws = True

    def __call__(self, generator, noise, condition=None, draws=None, progress=None):
        x = noise
        for j in range(self.steps):
            a, b = signal(j / self.steps), signal((j + 1) / self.steps)
            x_1 = ((x - (1 - a).sqrt() * generator.backbone(j / self.steps, x)) / a.sqrt()).clamp(-1, 1)
            direction = (x - a.sqrt() * x_1) / (1 - a).sqrt()
            sigma = ((1 - b) / (1 - a) * (1 - a / b)).sqrt()
            x = b.sqrt() * x_1 + (1 - b - sigma**2).clamp(min=0).sqrt() * direction
            x = x + sigma * draws(j + 1)
            if progress:
                progress()
        return Generated.after(x, evaluations=self.steps)


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


SAMPLERS.add("toy_steps", ToySteps)
GENERATORS.add("toy_ddpm", ToyDDPM)
STAGES.add("toy_ddpm", LearnNoise)
