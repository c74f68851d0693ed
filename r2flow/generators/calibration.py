"""Calibration of the density of a ray, fitted on simulated scans with errors of real sensors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
import yaml
from torch import Tensor

from r2flow.base.errors import check
from r2flow.base.files import parse_yaml, reading, write_file

_FEATURES = 3  # 1, log of the spread, log r
_NEAR = 1e-3  # spread in log r at which the features end, and 1
# Weights of `mixture` from which a fit begins.
_FIRST = ((0.0, 0, 0), (-4.0, 0, 0), (-4.0, 0, 0), (1.0, 0, 0), (0.0, 0, 0))


def mixture(
    weights: Tensor, logits: Tensor, ranges: Tensor, scales: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The calibrated mixture, (K + 1, N), of one with K candidates, (K, N).

    Candidates have logits t l and scales hypot(a b, c / r); one more, of weight e and scale d s, is
    at the mean. log a, log c, logit e, log d and log t are the products of `weights`, (5, 3), and
    the features 1, log s and log r (centred); s is the spread, sum p (|m - mean| + b).
    """
    p = logits.exp()
    mean = (p * ranges).sum(0)
    spread = (p * ((ranges - mean).abs() + scales)).sum(0)
    features = torch.stack(
        [torch.ones_like(mean), (spread.clamp(_NEAR, 1.0).log() + 3) / 2, mean - math.log(10)]
    )
    a, c, e, d, t = weights @ features
    wide = ((scales * a.exp()).square() + (2 * (c - mean)).exp()).sqrt()
    logits = (logits.clamp(min=-50) * t.exp()).log_softmax(0)
    return (
        torch.cat([logits + F.logsigmoid(-e), F.logsigmoid(e)[None]]),
        torch.cat([ranges, mean[None]]),
        torch.cat([wide, (spread * d.exp()).clamp(max=3)[None]]),
    )


@dataclass(frozen=True)
class Calibration:
    """Corrections of the predicted densities of a model.

    Attributes:
        spread: Weights of `mixture`, (5, 3); None: the density as it is.
        returns: A return's logit l becomes returns[0] l + returns[1].
        factors: Factors of the 68 % and the 95 % error, found on scans of one sensor.
    """

    spread: tuple[tuple[float, ...], ...] | None = None
    returns: tuple[float, float] = (1.0, 0.0)
    factors: tuple[float, ...] = (1.0, 1.0)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a YAML file with `spread` and `returns`."""
        with reading(path, 1 << 16, "calibration's YAML"):
            values: Any = parse_yaml(path.read_text(encoding="utf-8"))
            spread = tuple(tuple(map(float, row)) for row in values["spread"])
            sizes = [len(row) for row in spread]
            check(sizes == [_FEATURES] * len(_FIRST), f"{path}: spread is (5, 3), found {sizes}.")
            a, b = map(float, values["returns"])
            return cls(spread, (a, b))

    def write(self, path: Path, comment: str) -> None:
        values = {
            "spread": [[round(value, 4) for value in row] for row in self.spread or ()],
            "returns": [round(value, 4) for value in self.returns],
        }
        lines = "".join(f"# {line}\n" for line in comment.splitlines())
        write_file(path, lines + yaml.safe_dump(values, default_flow_style=None, width=100))

    def widen(
        self, logits: Tensor, ranges: Tensor, scales: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`mixture` by these weights."""
        if self.spread is None:
            return logits, ranges, scales
        return mixture(logits.new_tensor(self.spread), logits, ranges, scales)

    def factor(self, level: float) -> float:
        """Factor of the error of a level: that of 68 %, that of 95 %, or between them, linear in
        log(-log(1 - level)).
        """
        low, at, high = (math.log(-math.log1p(-x)) for x in (0.68, level, 0.95))
        share = min(max((at - low) / (high - low), 0.0), 1.0)
        return (1 - share) * self.factors[0] + share * self.factors[1]


def fitted(
    densities: Sequence[tuple[Tensor, Tensor, Tensor]],
    log_r: Tensor,
    logits: Tensor,
    returned: Tensor,
) -> Calibration:
    """The calibration of the largest likelihood.

    Args:
        densities: Logits, log r and scales of candidates, (K, N) each, in parts.
        log_r: The true log r of these rays, (N,).
        logits: Logits of a return, (M,), of all hidden rays.
        returned: Whether these returned, (M,) bool.
    """
    parts = [torch.cat(part, 1) for part in zip(*densities, strict=True)]
    weights = torch.tensor(_FIRST)
    line = torch.tensor([1.0, 0.0])
    _minimise(weights, lambda: _surprise(mixture(weights, *parts), log_r))
    _minimise(
        line,
        lambda: F.binary_cross_entropy_with_logits(line[0] * logits + line[1], returned.float()),
    )
    return Calibration(tuple(map(tuple, weights.tolist())), tuple(line.tolist()))


def _surprise(density: tuple[Tensor, Tensor, Tensor], log_r: Tensor) -> Tensor:
    logits, ranges, scales = density
    each = logits - (2 * scales).log() - (log_r - ranges).abs() / scales
    return -each.logsumexp(0).mean()


def _minimise(weights: Tensor, loss: Any) -> None:
    weights.requires_grad_()
    optimiser = torch.optim.LBFGS([weights], max_iter=40, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = loss()
        value.backward()
        return value

    optimiser.step(closure)
    weights.requires_grad_(False)
