"""A GAN: x = G(z), learned against a discriminator with the non-saturating loss (Goodfellow et al.
2014).
"""

from dataclasses import dataclass
from math import prod

from torch import nn
from torch.nn.functional import softplus

from r2flow.generators import GENERATORS, Generated, Generator
from r2flow.samplers import SAMPLERS, Sampler
from r2flow.stages import STAGES, Stage


class ToyGenerator(Generator):
    def __init__(self, space, backbone, latent: int = 8, width: int = 32):
        super().__init__(space, noise_shape=(latent,))
        self.run_by(OneEvaluation())
        self.network = nn.Sequential(
            nn.Linear(latent, width), nn.SiLU(), nn.Linear(width, prod(space.shape)), nn.Tanh(),
            nn.Unflatten(1, space.shape),
        )  # fmt: skip


@dataclass(frozen=True)
class OneEvaluation(Sampler):
    needs = "network"

    def __call__(self, generator, noise, condition=None, draws=None, progress=None):
        return Generated.after(generator.network(noise), evaluations=1)


class ToyGAN(Stage):
    generator_name = "toy_gan"

    def __init__(self, *model, width: int = 32, **options):
        super().__init__(*model, **options)
        self.automatic_optimization = False
        self.discriminator = nn.Sequential(
            nn.Flatten(), nn.Linear(prod(self.space.shape), width), nn.SiLU(), nn.Linear(width, 1)
        )

    def configure_optimizers(self):
        return self.optimizers_for(self.generator.parameters(), self.discriminator.parameters())

    def training_step(self, batch, batch_idx):
        for_generator, for_discriminator = self.own_optimizers()
        made = self.generator.network(batch["x_0"])
        wrong = softplus(self.discriminator(made.detach())) + softplus(
            -self.discriminator(batch["x_1"])
        )
        self.take_step(for_discriminator, wrong.mean())
        loss = softplus(-self.discriminator(made)).mean()
        self.take_step(for_generator, loss)
        self.log("train/loss", loss)


SAMPLERS.add("one_evaluation", OneEvaluation)
GENERATORS.add("toy_gan", ToyGenerator)
STAGES.add("toy_gan", ToyGAN)
