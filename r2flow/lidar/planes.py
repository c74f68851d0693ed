"""Returns moved to the planes that they lie on, for scans whose surfaces are rough by a percent of the range."""

import torch
import torch.nn.functional as F
from torch import Tensor

ROWS, COLUMNS = (-15, -11, -8, -5, -3, -2, -1, 0, 1, 2, 3, 5, 8, 11, 15), (-1, 0, 1)  # the window about a return
REACH, TIMES = 8.0, 2


def flattened(images: Tensor, rays: Tensor, sigma: float) -> Tensor:
    """Scans whose returns lie on the planes through their neighbours, (B, 2 or 1, H, W) as they were given.

    Along a plane 1 / (r cos e) is linear in tan e and, over a few columns, in the azimuth. Of each return with range r
    it becomes what the plane has there that fits its window by least squares, with the weights of a bilateral filter
    (Tomasi and Manduchi 1998, bilateral filtering for gray and color images)

        exp(-log(r_n / r)^2 / (2 sigma^2)) exp(-(i^2 + j^2) / (2 REACH^2))

    of the returns r_n that lie i rows and j columns off: those across an edge do not count. `TIMES` times. Which rays
    return, and reflectance, stay as they are.

    Args:
        images: Range in metres and, where known, reflectance; 0 without a return. Columns go all the way round.
        rays: Elevation and azimuth of every pixel in radians, (2, H, W).
        sigma: About how rough surfaces are, in log-range; above 0.
    """
    e, r = rays[0].to(images), images[:, 0]
    tan, cos, there = e.tan(), e.cos(), r > 0
    step = (tan[0] - tan[-1]).abs().amax(0).clamp(min=1e-6) / max(len(tan) - 1, 1)  # so that rows are about 1 apart
    rows = [i for i in ROWS if abs(i) < len(tan)]
    for _ in range(TIMES):
        q = torch.where(there, 1 / (r.clamp(min=1e-6) * cos), 0)
        moments, values = torch.zeros(()), torch.zeros(())
        for i in rows:
            u, below = (_shifted(tan, i) - tan) / step, _shifted(q, i)
            for j in COLUMNS:
                near = below.roll(-j, -1)
                seen = (near > 0) & there
                ratio = torch.where(seen, near / q, 1)
                far = ratio.log().square() / (2 * sigma**2) + (i * i + j * j) / (2 * REACH**2)
                w = torch.where(seen, (-far).exp(), 0)[:, None]
                v = torch.full_like(u, j)
                one = torch.ones_like(u)
                moments = moments + w * torch.stack([one, u, v, u * u, u * v, v * v])
                values = values + w * (ratio - 1)[:, None] * torch.stack([one, u, v])
        moved = 1 + _at_the_middle(moments, values).clamp(-0.2, 0.2)
        r = torch.where(there, r / moved, r)
    return torch.cat([r[:, None], images[:, 1:]], 1)


def _at_the_middle(moments: Tensor, values: Tensor) -> Tensor:
    """The constant a of a + b u + c v by weighted least squares, from the sums of the weights times 1, u, v, u^2, u v
    and v^2, (B, 6, H, W), and times the values, values u and values v, (B, 3, H, W).

    By Cramer's rule; a little is added to the diagonal, so that returns on one line have a plane too.
    """
    s, su, sv, suu, suv, svv = (moments + moments.new_tensor([0, 0, 0, 1e-3, 0, 1e-3])[:, None, None]).unbind(1)
    cofactors = torch.stack([suu * svv - suv * suv, sv * suv - su * svv, su * suv - sv * suu], 1)
    determinant = (cofactors * torch.stack([s, su, sv], 1)).sum(1)
    return (cofactors * values).sum(1) / determinant.clamp(min=1e-12)


def _shifted(x: Tensor, i: int) -> Tensor:
    """x_{h + i} at row h; 0 beyond the rows."""
    if not i:
        return x
    return F.pad(x[..., i:, :], (0, 0, 0, i)) if i > 0 else F.pad(x[..., :i, :], (0, 0, -i, 0))
