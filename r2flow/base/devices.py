"""Choice of the device."""

from typing import Any

from r2flow.base.errors import InputError


def choose_device(name: str, option: str = "--device") -> str:
    """Check the name of a device; `auto`: a GPU if available. `option` is its name in messages."""
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda", "mps", "xpu"):
        raise InputError(f"{option} must be auto, cpu, cuda, cuda:1, ..., not {name!r}.")
    count = getattr(torch, device.type).device_count()
    if (device.index or 0) >= count:
        seen = f"{count} of them" if count else "no GPU"
        raise InputError(f"{option} {name}, but torch sees {seen} here; use {option} cpu.")
    return name


def multiplies_bfloat16() -> bool:
    """Whether the CPU has instructions for products of bfloat16; False on torch below 2.10."""
    import torch

    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))
