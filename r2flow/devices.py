"""Choice of the device."""

from r2flow.errors import check


def choose_device(name: str, option: str = "--device") -> str:
    """Check the name of a device; `auto`: a GPU if available. `option` is its name in messages."""
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    check(device.type in ("cpu", "cuda", "mps", "xpu"), f"{option} must be auto, cpu, cuda, cuda:1, ..., not {name!r}.")
    count = getattr(torch, device.type).device_count()
    number = f"{count} of them" if count else "no GPU"
    check((device.index or 0) < count, f"{option} {name}, but torch sees {number} here; use {option} cpu.")
    return name
