"""Choice of the device."""

from r2flow.errors import InputError


def choose_device(name: str, option: str = "--device") -> str:
    """Check the name of a device; `auto`: a GPU if available. `option` is its name in messages."""
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda", "mps", "xpu") or (device.type == "cpu" and device.index):
        raise InputError(f"{option} must be auto, cpu, cuda, cuda:1, ...; found {name!r}.")
    module = {"cuda": torch.cuda, "mps": torch.mps, "xpu": torch.xpu}.get(device.type)
    if module is not None and (device.index or 0) >= module.device_count():
        number = f"{module.device_count()} of them" if module.device_count() else "no GPU"
        raise InputError(f"{option} {name}, but torch sees {number} here; use {option} cpu.")
    return name
