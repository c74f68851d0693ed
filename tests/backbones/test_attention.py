"""Neighbourhood attention: every backend against the definition by loops."""

import pytest
import torch
from torch import Tensor

from r2flow.backbones.attention import _Axis, _compiled_flex, _flex_mask, neighbourhood_attention
from r2flow.base.errors import InputError

# (rows, columns, window): tiled evenly or not, rings narrower than the window, fewer rows than the
# window
MAPS = [
    (8, 24, (3, 9)),
    (4, 8, (3, 9)),
    (9, 19, (3, 9)),
    (7, 15, (5, 7)),
    (6, 1, (3, 9)),
    (1, 3, (5, 9)),
    (3, 9, (3, 9)),
    (5, 6, (1, 1)),
]


def qkv(
    rows: int, columns: int, batch: int = 2, heads: int = 2, channels: int = 4
) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(rows * 100 + columns)
    shape = (batch, rows, columns, heads, channels)
    return tuple(torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(3))


def by_loops(q: Tensor, k: Tensor, v: Tensor, window: tuple[int, int], wrap: bool) -> Tensor:
    _, rows, columns, _, _ = q.shape
    height, width = min(window[0], rows), window[1] if wrap else min(window[1], columns)
    out = torch.empty_like(q)
    for i in range(rows):
        top = max(0, min(i - window[0] // 2, rows - height))
        for j in range(columns):
            left = j - window[1] // 2 if wrap else max(0, min(j - window[1] // 2, columns - width))
            seen = [
                (a, b % columns)
                for a in range(top, top + height)
                for b in range(left, left + width)
            ]
            keys = torch.stack([k[:, a, b] for a, b in seen], dim=-2)  # (B, N, seen, D)
            values = torch.stack([v[:, a, b] for a, b in seen], dim=-2)
            weights = torch.softmax((q[:, i, j, :, None] * keys).sum(-1), dim=-1)
            out[:, i, j] = (weights[..., None] * values).sum(-2)
    return out


def assert_defined(inputs, window, wrap, backend, atol):
    weights = torch.randn(inputs[0].shape, generator=torch.Generator().manual_seed(1)).to(inputs[0])
    outputs = (
        by_loops(*inputs, window, wrap),
        neighbourhood_attention(*inputs, window, wrap, backend=backend),
    )
    results = [[out, *torch.autograd.grad((out * weights).sum(), inputs)] for out in outputs]
    for expected, found in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize(("rows", "columns", "window"), MAPS)
def test_tiles_are_the_definition_in_value_and_gradient(rows, columns, window, wrap):
    assert_defined([x.requires_grad_() for x in qkv(rows, columns)], window, wrap, "auto", 1e-12)


def test_a_mask_made_while_sampling_serves_training_and_a_graph_two_backward_passes():
    with torch.inference_mode():
        mask = _flex_mask(_Axis(6, 3, wrap=False), _Axis(12, 5, wrap=True), torch.device("cpu"))
    assert not mask.kv_indices.is_inference()
    _compiled_flex()  # its kernels need CUDA, torch's rule for compiled backward passes does not
    x = torch.rand(3, requires_grad=True)
    y = torch.compile(lambda x: x.exp().sin(), backend="aot_eager", dynamic=True)(x).sum()
    # as in `mmps`
    assert torch.equal(*(torch.autograd.grad(y, x, retain_graph=True)[0] for _ in range(2)))


def test_a_backend_that_cannot_be_had_says_why():
    with pytest.raises(InputError, match="'flex' has kernels for CUDA only.*cpu"):
        neighbourhood_attention(*qkv(4, 8), (3, 9), backend="flex")


@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize(
    ("rows", "columns", "window"), [shape for shape in MAPS if shape[1] >= shape[2][1]]
)
def test_the_mask_for_flex_shows_what_tiles_see(rows, columns, window, wrap):
    """Its kernels need CUDA; whom it lets see whom does not."""
    count = rows * columns
    same = torch.zeros(1, rows, columns, 1, 1)  # all that a token sees counts alike
    each = torch.eye(count).view(1, rows, columns, 1, count)
    seen = neighbourhood_attention(same, same, each, window, wrap).reshape(count, count) > 0
    tokens = torch.arange(count)
    axes = _Axis(rows, window[0], wrap=False), _Axis(columns, window[1], wrap=wrap)
    sees = _flex_mask(*axes, torch.device("cpu")).mask_mod
    assert torch.equal(sees(None, None, tokens[:, None], tokens[None]), seen)


@pytest.mark.gpu
@pytest.mark.parametrize("backend", ["tiles", "flex"])
def test_backends_are_the_definition_on_a_gpu(backend):
    inputs = [x.float().cuda().requires_grad_() for x in qkv(16, 64, channels=32)]
    assert_defined(inputs, (3, 9), True, backend, 2e-2)  # TF32 in some kernels
