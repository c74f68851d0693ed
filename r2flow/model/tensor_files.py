"""Files of tensors and plain values: read without code execution, with their checksums compared."""

import json
import os
import pickle
import re
import warnings
import zipfile
from pathlib import Path
from typing import IO, Any

import torch
from safetensors import safe_open
from torch import Tensor

from r2flow.base.config import check_tree
from r2flow.base.errors import InputError
from r2flow.base.files import reading_errors, refuse_pointer
from r2flow.base.hashing import state_hash
from r2flow.model.parts import HYPER, NOTES
from r2flow.model.published import inert, plain


def read_checkpoint(path: str | Path, map_location: Any = "cpu") -> Any:
    """Read an r2flow checkpoint, a dict, or a published one. Only tensors and plain values: a file
    cannot run code.
    """
    with reading_errors(Path(path)), open(path, "rb") as file:
        refuse_pointer(Path(path))
        return read_torch(file, path, map_location)


def read_torch(file: IO[bytes], name: object, map_location: Any = "cpu") -> Any:
    """Read tensors and plain values from a torch file, without code execution; `InputError` for any
    other content.
    """
    _check_archive(file, name)
    try:
        with warnings.catch_warnings(action="ignore"), inert():  # torch may warn
            content = torch.load(file, map_location=map_location, weights_only=True)
            if not isinstance(content, dict):
                return content
            content = {key: plain(value) for key, value in content.items()}
            check_tree(content.get(HYPER) or {})
            return content
    except Exception as error:  # torch.load raises nearly any exception on other files
        if isinstance(error, OSError) and error.errno is not None:
            raise
        code = re.search(r"(?:GLOBAL|Unsupported (?:global|class):?(?: GLOBAL)?) (\S+)", str(error))
        if code is not None and isinstance(error, pickle.UnpicklingError):
            raise InputError(
                f"{name} is refused: it holds objects that would run code when loaded ({code[1]}), "
                "not only tensors and plain values. Ask its author for a weights-only file."
            ) from None
        raise InputError(
            f"{name} is not a checkpoint, or a damaged one ({file.seek(0, os.SEEK_END)} bytes). "
            "Give a .ckpt of r2flow or a published file."
        ) from None


def _check_archive(file: IO[bytes], name: object) -> None:
    """Refuse zip archives with compressed entries (zip bombs), which torch never writes, and those
    whose checksums (CRC-32) differ, which torch does not compare.
    """
    try:
        archive = zipfile.ZipFile(file)
    except Exception:  # torch's legacy format, or damaged: torch.load tells
        file.seek(0)
        return
    entries = archive.infolist()
    if sum(entry.file_size for entry in entries) > file.seek(0, os.SEEK_END) or any(
        entry.compress_type for entry in entries
    ):
        raise InputError(
            f"{name} holds compressed tensors, which torch never writes. Ask its author for "
            "another file."
        )
    try:
        broken = archive.testzip()
    except Exception:  # a damaged header of an entry
        broken = "an entry"
    if broken is not None:
        raise InputError(
            f"{name} is damaged: the checksum of {broken} differs. Copy or fetch it again."
        )
    file.seek(0)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors and the metadata of a `.safetensors`."""
    refuse_pointer(path)
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118


def read_safetensors(path: Path) -> dict[str, Any]:
    """Read `weights`, config, step and samplers of an r2flow `.safetensors`."""
    weights, metadata = read_tensors(path)
    notes = json.loads(metadata.get(NOTES, "{}"))
    if not isinstance(notes, dict) or notes.pop("digest", None) != state_hash(weights, notes):
        raise InputError(
            f"{path} is not a model of r2flow, or damaged: its checksum differs. Use another "
            "checkpoint."
        )
    check_tree(notes["config"])
    return notes | {"weights": weights}


def is_dense(value: object) -> bool:
    """Whether a value is a dense real tensor."""
    if not isinstance(value, Tensor) or value.layout != torch.strided:
        return False
    return not (value.is_meta or value.is_quantized or value.is_complex())
