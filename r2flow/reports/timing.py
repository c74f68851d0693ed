"""Seconds of a call, on any device."""

import time
from collections.abc import Callable
from typing import TypeVar

import torch

T = TypeVar("T")


def timed(call: Callable[[], T], device: torch.device | str = "cpu") -> tuple[T, float]:
    """What a call returns, and its seconds, the device's work included."""
    wait = torch.cuda.synchronize if torch.device(device).type == "cuda" else lambda device: None
    wait(device)
    begin = time.perf_counter()
    result = call()
    wait(device)
    return result, time.perf_counter() - begin
