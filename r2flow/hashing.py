"""Hashes of tensors."""

import hashlib
from collections.abc import Mapping

import torch
from torch import Tensor


def state_hash(state: Mapping[str, Tensor], prefix: bytes = b"") -> str:
    """SHA-256 (64 hex digits) of names, shapes, types and bytes of tensors, after a prefix."""
    digest = hashlib.sha256(prefix)
    for name, value in sorted(state.items()):
        digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
        digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
