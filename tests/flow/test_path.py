import torch

from r2flow.flow.path import interpolate


def test_the_line_ends_in_noise_and_in_data_and_u_is_its_derivative():
    x_0, x_1 = torch.randn(3, 2, 4, 8, dtype=torch.float64), torch.randn(3, 2, 4, 8, dtype=torch.float64)
    t = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    assert torch.equal(interpolate(x_0, x_1, torch.zeros(3))[0], x_0)
    assert torch.equal(interpolate(x_0, x_1, torch.ones(3))[0], x_1)
    h = 1e-6
    derivative = (interpolate(x_0, x_1, t + h)[0] - interpolate(x_0, x_1, t - h)[0]) / (2 * h)
    torch.testing.assert_close(derivative, interpolate(x_0, x_1, t)[1], rtol=0, atol=1e-8)
