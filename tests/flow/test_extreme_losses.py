"""Residual 0 and 1e6 in half precision: the loss is finite and right, its gradient too."""

import math

import pytest
import torch

from r2flow.flow.losses import LOSSES

D = 2 * 4 * 8
C = 0.00054 * math.sqrt(D)
# of one residual r in all D elements: mean square; sqrt(D r^2 + C^2) - C over sqrt(D); sqrt(r^2 + C^2) - C
EXPECTED = {
    "mse": lambda r: r**2,
    "pseudo_huber": lambda r: (math.sqrt(D * r**2 + C**2) - C) / math.sqrt(D),
    "pseudo_huber_elementwise": lambda r: math.sqrt(r**2 + C**2) - C,
    "absolute": abs,
}


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("name", list(LOSSES))
class TestHalfPrecision:
    def test_residual_zero(self, name, dtype):
        v = torch.full((1, 2, 4, 8), 0.7, dtype=dtype, requires_grad=True)
        loss = LOSSES[name](v, v.detach())
        loss.sum().backward()
        assert loss.dtype == torch.float32
        assert loss.item() == 0
        assert v.grad.abs().max() == 0

    @pytest.mark.parametrize("residual", [1e-4, 1.0, 1e6])
    def test_a_residual_that_half_precision_can_hold_or_not(self, name, dtype, residual):
        # 1e6 is beyond float16: the target has it, in float32, and the estimate is 0
        v = torch.zeros(1, 2, 4, 8, dtype=dtype, requires_grad=True)
        loss = LOSSES[name](v, torch.full((1, 2, 4, 8), residual))
        loss.sum().backward()
        assert loss.item() == pytest.approx(EXPECTED[name](residual), rel=1e-3)
        if name == "mse" and residual == 1e6:
            # d/dv r^2 / D = 2 r / D = 31250, which float16 holds
            assert v.grad.float().abs().max().item() == pytest.approx(2 * residual / D, rel=1e-2)
        assert v.grad.isfinite().all()
        assert (v.grad <= 0).all()

    def test_infinity_and_nan_are_not_hidden(self, name, dtype):
        for value in (math.inf, math.nan):
            loss = LOSSES[name](torch.full((1, 2, 4, 8), value, dtype=dtype), torch.zeros(1, 2, 4, 8))
            assert not loss.isfinite().any()  # the stage's guard sees it
