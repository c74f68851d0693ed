"""Vector quantisation (van den Oord et al. 2017)."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Quantiser(nn.Module):
    """q(z), the code e_k nearest to each vector z, and the mean over all elements of the loss

        |q - sg z|^2 + beta |sg q - z|^2

    with sg the stop-gradient (van den Oord et al. 2017, eq. 3). The first term moves codes, the
    second (commitment) vectors. `legacy` applies beta to the first term instead, as in the
    published code of LiDM.
    """

    def __init__(self, codes: int, channels: int, beta: float = 0.25, legacy: bool = False) -> None:
        super().__init__()
        self.beta = beta
        self.legacy = legacy
        self.embedding = nn.Embedding(codes, channels)
        nn.init.uniform_(self.embedding.weight, -1 / codes, 1 / codes)

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """The codes nearest to z, (B, C, H, W), with straight-through gradient; the loss, ()."""
        vectors = z.movedim(1, -1)
        q = self.embedding(self.nearest(vectors))
        codebook = F.mse_loss(q, vectors.detach())
        commitment = F.mse_loss(q.detach(), vectors)
        if self.legacy:
            loss = self.beta * codebook + commitment
        else:
            loss = codebook + self.beta * commitment
        return (vectors + (q - vectors).detach()).movedim(-1, 1), loss

    @torch.no_grad()
    def nearest(self, vectors: Tensor) -> Tensor:
        """Index of the code nearest to each vector, (..., C) to (...)."""
        codes = self.embedding.weight.float()
        lengths = codes.square().sum(1)
        # Full precision, for differences of large numbers; |part|^2 is common to all codes.
        with torch.autocast(vectors.device.type, enabled=False):
            parts = [
                torch.addmm(lengths, part, codes.T, alpha=-2).argmin(1)
                for part in vectors.flatten(0, -2).float().split(4096)  # not all distances at once
            ]
        return torch.cat(parts).view(vectors.shape[:-1])
