"""Defect control: sees pulses of the velocity in time between the stages of a long step.

Dormand and Prince's method evaluates the velocity at its stages alone and misses a pulse between
two of them. Therefore v is compared with the slope of the step's interpolant at further times
(Enright, A new error control for initial value solvers, 1989) where two evaluations would be more
than `_UNSEEN` apart.
"""

import math

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.flow.solvers.batched import norms, powered, unpowered
from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.step_size import StepController

_UNSEEN = 0.15  # longest part of the interval between two evaluations
# The longest parts of a step of dopri5 between stages with a weight in its error estimate.
_GAPS = ((0.0, 0.3), (0.3, 0.8))
# Offset of a probe in its part of a gap, against aliasing with regular patterns.
_OFF_CENTRE = 0.5 - 1 / math.sqrt(5)
# Largest |h (v - slope)| in tolerances: several times that of accurate steps of the exact problems.
_DEFECT = 60.0


@torch.no_grad()
def missed(
    control: StepController, x: Tensor, k: Tensor, h: Tensor, scale: Tensor, good: ndarray
) -> ndarray:
    """Which good steps from x, (B, ...), of stages k, (stages, B, ...), step over a pulse, (B,)."""
    found = np.zeros_like(good)
    for left, right in _GAPS:
        pieces = np.ceil((right - left) / _UNSEEN * control.h / control.length)
        for i in range(1, int(pieces.max())):
            places = (good & ~found & (i < pieces) & (control.budget() > 0)).nonzero()[0]
            if not len(places):
                continue
            theta = left + (right - left) * (i + _OFF_CENTRE) / pieces[places]
            weights = x.new_tensor(interpolant(control.method, theta))
            weights = weights.view(*weights.shape, *(1,) * (x.ndim - 1))
            shift, slope = (weights * k[:, places]).sum(1)
            length = expand_time(h[places], shift)
            t = control.time(control.reached[places] + theta * control.h[places])
            v = control.v.some(places, x.new_tensor(t), x[places] + length * shift)
            found[places] = ~(
                unpowered(norms(powered((v - slope) * length / scale[places]))[0]) <= _DEFECT
            )
    return found


def interpolant(method: EmbeddedMethod, theta: ndarray) -> ndarray:
    """w_i and dw_i / dtheta of x + h sum_i w_i(theta) k_i, (2, stages, B).

    Cubic Hermite interpolant plus a quartic bump, continuously differentiable: Hairer, Norsett,
    Wanner, Solving Ordinary Differential Equations I, II.6.
    """
    b = np.array([*method.rows[-1], 0.0])[:, None]
    d = np.array(method.bump)[:, None]
    rest = 1 - theta
    state = b * (theta**2 * (3 - 2 * theta)) + d * (theta * rest) ** 2
    state[0] += theta * rest**2
    state[-1] -= theta**2 * rest
    slope = b * (6 * theta * rest) + d * (2 * theta * rest * (1 - 2 * theta))
    slope[0] += rest * (1 - 3 * theta)
    slope[-1] -= theta * (2 - 3 * theta)
    return np.stack([state, slope])
