"""Hashes of tensors."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor


def state_hash(
    state: Mapping[str, Tensor | np.ndarray], notes: Mapping[str, Any] | None = None
) -> str:
    """SHA-256 (64 hex digits) of names, shapes, types and bytes of tensors or arrays, after the
    JSON of `notes`.
    """
    digest = hashlib.sha256(b"" if notes is None else json.dumps(notes, sort_keys=True).encode())
    for name, value in sorted(state.items()):
        digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
        if isinstance(value, Tensor):
            value = value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy()
        digest.update(np.ascontiguousarray(value).data)
    return digest.hexdigest()
