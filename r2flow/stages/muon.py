"""Muon: momentum with equalised singular values for matrices, AdamW for other weights."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

_LEAST_CHANNELS = 8  # fewer: input or output layer of an image


class Muon(torch.optim.AdamW):
    """AdamW whose steps for weight matrices are orthogonal matrices (Jordan et al. 2024, "Muon").

    With the gradient G of a weight matrix, (rows, columns), a convolution's flattened to (out, in x
    height x width):

        M <- m M + (1 - m) G,    W <- W - rate sqrt(max(1, rows / columns)) orthogonalised((1 - m) G
        + m M)

    All singular directions of the momentum are learned at the same speed, instead of the few large
    ones first. AdamW, with `options`, trains biases, norms and matrices with fewer than 8 rows or
    columns, such as those of an image's channels.
    """

    def __init__(
        self, parameters: Iterable[Tensor], rate: float, momentum: float = 0.95, **options: Any
    ) -> None:
        weights = list(parameters)
        matrices = [p for p in weights if is_hidden_matrix(p)]
        others = [p for p in weights if not is_hidden_matrix(p)]
        groups: list[dict[str, Any]] = [
            {"params": others, "momentum": None},
            {"params": matrices, "lr": rate, "momentum": momentum},
        ]
        super().__init__([group for group in groups if group["params"]], **options)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        loss = None
        if closure is not None:  # it clears, computes and clips the gradients of all groups
            with torch.enable_grad():
                loss = closure()
        groups = self.param_groups
        self.param_groups = [group for group in groups if group["momentum"] is None]
        super().step()
        self.param_groups = groups
        for group in groups:
            for p in group["params"]:
                if group["momentum"] is not None and p.grad is not None:
                    self._step(p, p.grad, group)
        return loss

    def _step(self, p: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        state = self.state[p]
        if not state:
            state["momentum"] = torch.zeros_like(p, memory_format=torch.preserve_format)
            state["step"] = torch.tensor(0.0)  # AdamW requires it in every loaded state
        average: Tensor = state["momentum"]
        average.lerp_(gradient, 1 - group["momentum"])
        direction = orthogonalised(gradient.lerp(average, group["momentum"]).flatten(1))
        rows, columns = direction.shape
        p.mul_(1 - group["lr"] * group["weight_decay"])
        p.add_(direction.reshape(p.shape), alpha=-group["lr"] * math.sqrt(max(1.0, rows / columns)))


def is_hidden_matrix(p: Tensor) -> bool:
    """Whether a weight has at least `_LEAST_CHANNELS` output and input channels."""
    return p.ndim >= 2 and min(p.shape[:2]) >= _LEAST_CHANNELS


def orthogonalised(matrix: Tensor) -> Tensor:
    """Approximate U V^T of a matrix U S V^T, (rows, columns): singular values become 0.68 to 1.14,
    tiny ones less.

    Newton-Schulz iteration in bfloat16: each step is a polynomial a X + (b A + c A A) X with A = X
    X^T.
    """
    x = matrix.T if matrix.shape[0] > matrix.shape[1] else matrix
    x = (x / (torch.linalg.matrix_norm(x) + 1e-7)).bfloat16()
    for _ in range(5):
        square = x @ x.T
        x = 3.4445 * x + (-4.7750 * square + 2.0315 * square @ square) @ x
    x = x.to(matrix.dtype)
    return x.T if matrix.shape[0] > matrix.shape[1] else x
