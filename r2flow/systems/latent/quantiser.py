"""Vector quantisation by a learned codebook (van den Oord et al. 2017, "Neural discrete representation learning")."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

AT_ONCE = 4096  # vectors per block of distances to all codes


class Quantised(NamedTuple):
    """Output of a quantiser for z, (B, C, H, W)."""

    codes: Tensor  # nearest codes, (B, C, H, W), with straight-through gradient
    loss: Tensor  # codebook and commitment loss, ()
    indices: Tensor  # indices of the codes, (B H W,) int64


class Quantiser(nn.Module):
    """q(z), the code e_k nearest to each vector z, and the mean over all elements of the loss

        |q - sg z|^2 + beta |sg q - z|^2

    with sg the stop-gradient (2017, eq. 3). The first term moves codes, the second (commitment) vectors. `legacy`
    applies beta to the first term instead, as in the published code of LiDM.
    """

    def __init__(self, codes: int, channels: int, beta: float = 0.25, legacy: bool = False) -> None:
        super().__init__()
        self.beta, self.legacy = beta, legacy
        self.embedding = nn.Embedding(codes, channels)
        nn.init.uniform_(self.embedding.weight, -1 / codes, 1 / codes)

    def forward(self, z: Tensor) -> Quantised:
        vectors = z.movedim(1, -1)
        indices = self.nearest(vectors.detach().flatten(0, -2))
        q = self.embedding(indices).view(vectors.shape)
        codebook, commitment = (q - vectors.detach()).square().mean(), (q.detach() - vectors).square().mean()
        loss = self.beta * codebook + commitment if self.legacy else codebook + self.beta * commitment
        through = vectors + (q - vectors).detach()
        return Quantised(through.movedim(-1, 1), loss, indices)

    @torch.no_grad()
    def nearest(self, vectors: Tensor) -> Tensor:
        """Index of the code nearest to each vector, (N, C) to (N,)."""
        codes = self.embedding.weight.float()
        lengths = codes.square().sum(1)
        with torch.autocast(vectors.device.type, enabled=False):  # full precision, for differences of large numbers
            parts = [
                (part.square().sum(1, keepdim=True) + lengths - 2 * part @ codes.T).argmin(1)
                for part in vectors.float().split(AT_ONCE)
            ]
        return torch.cat(parts)
