"""The reference cases, tensors computed once with the published implementation: reading and comparing."""

import zlib
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn


def load_case(path: Path) -> dict[str, Any]:
    """A case, its weights drawn again from their seed where the file holds only their names."""
    if not path.exists():
        pytest.skip(f"the reference case {path.name} is not here")
    case = torch.load(path, map_location="cpu", weights_only=False)
    if "sd_spec" in case and case.get("state_dict") is None:
        case["state_dict"] = {
            name: _draw(name, shape, kind, case["seed"]) if tensor is None else tensor.clone()
            for name, shape, kind, tensor in case["sd_spec"]
        }
    return case


def _draw(name: str, shape: tuple[int, ...], kind: str, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed((zlib.crc32(name.encode()) ^ (seed * 0x9E3779B1)) & 0x7FFFFFFF)
    z = torch.randn(tuple(shape), generator=generator)
    fan_in = max(1, z[0].numel()) if z.ndim else 1
    return {
        "matrix": lambda: z / fan_in**0.5,
        "half_matrix": lambda: 0.5 * z / fan_in**0.5,
        "bias": lambda: 0.1 * z,
        "gain": lambda: 1 + 0.2 * z,
        "logit_scale": lambda: 2.302585092994046 + 1.2 * z,
        "alpha": lambda: z,
        "ape": lambda: 0.5 * z,
        "rff": lambda: z,
    }[kind]()


def relative(found: Tensor, expected: Tensor) -> float:
    """|found - expected| / |expected|, in the Euclidean norm of all elements."""
    return ((found - expected).norm() / expected.norm()).item()


def assert_gradients(model: nn.Module, x: Tensor, output: Tensor, case: dict[str, Any]) -> None:
    """The gradients of sum(output * grad_w) are the reference's to 1e-3: by x in full, by parameters in norm."""
    (output * case["grad_w"]).sum().backward()
    assert relative(x.grad, case["grad_x"]) < 1e-3
    for name, parameter in model.named_parameters():
        expected = case["grad_param_norms"][name]
        assert abs(parameter.grad.norm().item() - expected) <= 1e-3 * expected + 1e-6, name
