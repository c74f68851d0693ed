"""Reference cases, tensors computed once with the published code of a system: reading and
comparing.
"""

import json
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from r2flow.backbones import BACKBONES, Backbone

SCALES = {
    "half": 0.5,
    "bias": 0.1,
    "std01": 0.1,
    "codebook": 0.3,
    "unit100": 100.0,
    "ape": 0.5,
    "bn_mean": 0.2,
}


def load_case(shared: Path, name: str) -> dict[str, Any]:
    """A case, its weights drawn again from their seed where the file holds only their names."""
    path = next(shared.glob(f"oracle*/{name}"), None)
    if path is None:
        pytest.skip(f"the reference case {name} is not here")
    case: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    if "sd_spec" in case:
        case["state_dict"] = {
            name: _draw(name, shape, kind, case["seed"]) if tensor is None else tensor.clone()
            for name, shape, kind, tensor in case["sd_spec"]
        }
    return case


def _draw(name: str, shape: tuple[int, ...], kind: str, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(
        (zlib.crc32(name.encode()) ^ (seed * 0x9E3779B1)) & 0x7FFFFFFF
    )
    z = torch.randn(tuple(shape), generator=generator)
    if kind in ("matrix", "half_matrix"):
        return z * (0.5 if kind == "half_matrix" else 1) / max(1, z[0].numel()) ** 0.5
    if kind in ("gain", "bn_var"):
        return 1 + 0.2 * z if kind == "gain" else (1 + 0.2 * z).abs() + 0.1
    if kind == "logit_scale":
        return 2.302585092994046 + 1.2 * z
    return SCALES.get(kind, 1.0) * z


OPTIONS = {
    "attn_num_heads": "num_heads", "temb_channels": "time_channels", "time_embed_channels": "time_channels",
    "coords_encoding": "position", "positional_embedding": "position", "gn_num_groups": "groups", "gn_eps": "eps",
}  # fmt: skip
KEPT = ("base_channels", "channel_multiplier", "num_residual_blocks", "depths", "num_heads", "ring")


def backbone_of(name: str, case: dict[str, Any]) -> Backbone:
    """The backbone of a case with its weights, among which are its rays."""
    cfg = case["cfg"]
    options = {
        OPTIONS.get(key, key): value for key, value in cfg.items() if key in (*OPTIONS, *KEPT)
    }
    model = BACKBONES.build(
        {"name": name, **options},
        torch.zeros(2, *cfg["resolution"]),
        in_channels=cfg["in_channels"],
    )
    model.load_state_dict(case["state_dict"])
    return model


def relative(found: Tensor, expected: Tensor) -> float:
    """|found - expected| / |expected|, in the Euclidean norm of all elements."""
    return ((found - expected).norm() / expected.norm()).item()


def assert_near(found: Any, expected: Any, tolerance: float) -> None:
    """|found - expected| is at most the tolerance times the largest |expected|."""
    found, expected = (torch.as_tensor(one).detach().double() for one in (found, expected))
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= tolerance * expected.abs().max()


def assert_norms(
    model: nn.Module, norms: Mapping[str, float | None], tolerance: float = 1e-3, prefix: str = ""
) -> None:
    """The norm of every parameter's gradient; those that the case does not name have none.

    Where a gradient is 0 by the mathematics, as by a bias before a softmax, both are rounding.
    """
    expected = {name: norm or 0.0 for name, norm in norms.items()}
    least = 1e-6 * max(expected.values())
    for name, parameter in model.named_parameters():
        norm, known = (
            0.0 if parameter.grad is None else parameter.grad.norm().item(),
            expected.get(prefix + name, 0.0),
        )
        assert abs(norm - known) <= tolerance * known + least, name
    assert set(expected) <= {prefix + name for name, _ in model.named_parameters()}


def assert_published(
    model: nn.Module,
    case: dict[str, Any],
    tolerance: float,
    call: Callable[[dict[str, Tensor]], Any],
) -> dict[str, Tensor]:
    """A network's outputs, and their gradients by inputs and parameters, are the case's; the
    outputs, by name.
    """
    given = {name: value.clone() for name, value in case["inputs"].items()}
    for name in case["grad_inputs"]:
        given[name].requires_grad_()
    made = call(given)
    made = made if isinstance(made, dict) else dict.fromkeys(case["outputs"], made)
    for name, expected in case["outputs"].items():
        assert_near(made[name], expected, tolerance)
    sum((made[name] * weight).sum() for name, weight in case["grad_w"].items()).backward()
    for name, expected in case["grad_inputs"].items():
        assert_near(given[name].grad, expected, 1e-3)
    assert_norms(model, case["grad_param_norms"])
    return made


def published_names(shared: Path, system: str) -> dict[str, list[int]]:
    """The shape of each weight of a published network of full size."""
    return dict(
        json.loads((shared / "oracle_baselines" / "state_dict_keys.json").read_text())[system][
            "names"
        ]
    )


def shapes_of(model: nn.Module) -> dict[str, list[int]]:
    return {name: list(value.shape) for name, value in model.state_dict().items()}
