"""Reference cases of other systems, computed once with their published code: reading and comparing."""

import zlib
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

SCALES = {"half": 0.5, "bias": 0.1, "std01": 0.1, "codebook": 0.3, "unit": 1.0, "unit100": 100.0}


def load_case(shared: Path, name: str) -> dict[str, Any]:
    """A case, its weights drawn again from their seed where the file holds only their names."""
    path = shared / "oracle_baselines" / name
    if not path.exists():
        pytest.skip(f"the reference case {path.name} is not here")
    case: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    if "sd_spec" in case:
        case["state_dict"] = {
            name: _draw(name, shape, kind, case["seed"]) if tensor is None else tensor.clone()
            for name, shape, kind, tensor in case["sd_spec"]
        }
    return case


def _draw(name: str, shape: tuple[int, ...], kind: str, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed((zlib.crc32(name.encode()) ^ (seed * 0x9E3779B1)) & 0x7FFFFFFF)
    z = torch.randn(tuple(shape), generator=generator)
    if kind == "gain":
        return 1 + 0.2 * z
    if kind in ("matrix", "half_matrix"):
        return z * (0.5 if kind == "half_matrix" else 1) / max(1, z[0].numel()) ** 0.5
    return SCALES[kind] * z


def assert_near(found: Any, expected: Any, tolerance: float) -> None:
    """|found - expected| is at most the tolerance times the largest |expected|."""
    found, expected = (torch.as_tensor(one).detach().double() for one in (found, expected))
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= tolerance * expected.abs().max()


def assert_norms(model: nn.Module, expected: dict[str, float], tolerance: float = 1e-3, prefix: str = "") -> None:
    """The norm of every parameter's gradient; those that the case does not name have none.

    Where a gradient is 0 by the mathematics, as by a bias before a softmax, both are rounding.
    """
    least = 1e-6 * max(expected.values())
    for name, parameter in model.named_parameters():
        norm = 0.0 if parameter.grad is None else parameter.grad.norm().item()
        assert abs(norm - expected.get(prefix + name, 0.0)) <= tolerance * expected.get(prefix + name, 0.0) + least, (
            name
        )
    assert set(expected) <= {prefix + name for name, _ in model.named_parameters()}
