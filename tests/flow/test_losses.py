import math

import pytest
import torch

from r2flow.flow.losses import LOSSES, mse, pseudo_huber_elementwise


def test_the_reference_pseudo_huber_is_per_element(shared):
    case = torch.load(shared / "oracle" / "training.pt", weights_only=False)["pseudo_huber"]
    torch.testing.assert_close(
        pseudo_huber_elementwise(case["v"], case["u"]).mean(), case["loss"], rtol=1e-6, atol=0
    )
    torch.testing.assert_close(
        pseudo_huber_elementwise(case["v2"], case["u2"]).mean(), case["loss2"], rtol=1e-6, atol=0
    )
    torch.testing.assert_close(mse(case["v2"], case["u2"]).mean(), case["mse2"], rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", list(LOSSES))
def test_a_loss_has_one_value_per_sample_and_they_are_independent(name):
    v, u = torch.randn(3, 2, 4, 8), torch.randn(3, 2, 4, 8)
    together = LOSSES[name](v, u)
    alone = torch.cat([LOSSES[name](v[i : i + 1], u[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(together, alone, rtol=1e-6, atol=0)


@pytest.mark.parametrize("size", [1.0, 1e12, 1e18, 1e30])
def test_pseudo_huber_is_finite_wherever_its_value_is(size):
    # d = 131,072 elements of +-size: sqrt(d size^2 + c^2) - c over sqrt(d), so size within 1e-3.
    v = torch.full((1, 2, 64, 1024), size, requires_grad=True)
    loss = LOSSES["pseudo_huber"](v, torch.zeros_like(v))
    loss.sum().backward()
    assert loss.item() == pytest.approx(size, rel=1e-3)
    assert v.grad.sum().item() == pytest.approx(1, rel=1e-3)


D = 2 * 4 * 8
C = 0.00054 * math.sqrt(D)
# of one residual r in all D elements: mean square; sqrt(D r^2 + C^2) - C over sqrt(D); sqrt(r^2 +
# C^2) - C
EXPECTED = {
    "mse": lambda r: r**2,
    "pseudo_huber": lambda r: (math.sqrt(D * r**2 + C**2) - C) / math.sqrt(D),
    "pseudo_huber_elementwise": lambda r: math.sqrt(r**2 + C**2) - C,
    "absolute": abs,
}


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("name", list(LOSSES))
class TestHalfPrecision:
    @pytest.mark.parametrize("residual", [0, 1e-4, 1.0, 1e6])
    def test_a_residual_that_half_precision_can_hold_or_not(self, name, dtype, residual):
        # 1e6 is beyond float16: the target has it, in float32, and the estimate is 0
        v = torch.zeros(1, 2, 4, 8, dtype=dtype, requires_grad=True)
        loss = LOSSES[name](v, torch.full((1, 2, 4, 8), residual))
        loss.sum().backward()
        assert loss.dtype == torch.float32
        assert loss.item() == pytest.approx(EXPECTED[name](residual), rel=1e-3)
        h = residual / 1000 or 1e-9
        slope = (EXPECTED[name](residual + h) - EXPECTED[name](residual - h)) / (2 * h)
        torch.testing.assert_close(
            v.grad.float(), torch.full(v.shape, -slope / D), rtol=0.02, atol=1e-7
        )

    def test_infinity_and_nan_are_not_hidden(self, name, dtype):
        for value in (math.inf, math.nan):
            loss = LOSSES[name](
                torch.full((1, 2, 4, 8), value, dtype=dtype), torch.zeros(1, 2, 4, 8)
            )
            assert not loss.isfinite().any()  # the stage's guard sees it
