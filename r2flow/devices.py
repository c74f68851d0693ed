"""Where a generator computes."""

from r2flow.errors import InputError


def choose_device(name: str, option: str = "--device") -> str:
    """A device's name, checked; `auto` takes a GPU where there is one.

    Args:
        option: What it was given as.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda", "mps", "xpu") or (device.type == "cpu" and device.index):
        raise InputError(f"{option} must be auto, cpu, cuda, cuda:1, ...; found {name!r}.")
    there = {"cuda": torch.cuda, "mps": torch.mps, "xpu": torch.xpu}.get(device.type)
    if there is not None and (device.index or 0) >= there.device_count():
        seen = f"{there.device_count()} of them" if there.device_count() else "no GPU"
        raise InputError(f"{option} {name}, but torch sees {seen} here; use {option} cpu.")
    return name
