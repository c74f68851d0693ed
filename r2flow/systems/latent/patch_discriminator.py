"""A discriminator that judges patches (Isola et al. 2017, "Image-to-image translation with conditional adversarial
networks"). Parameters carry the published weights' names."""

from torch import Tensor, nn

from r2flow.registry import Count


class PatchDiscriminator(nn.Module):
    """Images (B, channels, H, W) to a map of scores: 4 x 4 convolutions, batch norm and leaky ReLU.

    Args:
        channels: Of the images.
        width: Of the first convolution; each further one doubles it, up to 8 times.
        layers: Convolutions that halve the image.

    Attributes:
        smallest: The fewest rows or columns of an image that leave a score.
    """

    def __init__(self, channels: Count = 1, width: Count = 64, layers: Count = 3) -> None:
        super().__init__()
        self.smallest = 3 * 2**layers  # halved so often, and two convolutions of 4 without stride
        parts: list[nn.Module] = [nn.Conv2d(channels, width, 4, 2, 1), nn.LeakyReLU(0.2)]
        here = width
        for layer in range(1, layers + 1):
            after = width * min(2**layer, 8)
            stride = 2 if layer < layers else 1
            parts += [
                nn.Conv2d(here, after, 4, stride, 1, bias=False), nn.BatchNorm2d(after), nn.LeakyReLU(0.2),
            ]  # fmt: skip
            here = after
        self.main = nn.Sequential(*parts, nn.Conv2d(here, 1, 4, 1, 1))
        for module in self.main:
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, 0, 0.02)
            elif isinstance(module, nn.BatchNorm2d):
                nn.init.normal_(module.weight, 1, 0.02)

    def forward(self, x: Tensor) -> Tensor:
        return self.main(x)
