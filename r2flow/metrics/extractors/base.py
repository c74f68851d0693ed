"""Feature networks, and the weights of published ones: sources, installation and loading.

r2flow does not download. It reads a file from disk as tensors only, checks it against its network
and stores it as safetensors in the folder of weights, from which `Extractor.trained` loads it.
"""

import io
import tarfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Self

import torch
from safetensors.torch import save
from torch import Tensor, nn

from r2flow.base.errors import InputError
from r2flow.base.files import cache_folder, reading, reading_errors, write_file
from r2flow.base.hashing import state_hash
from r2flow.base.registry import Registry
from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.scans import Scans
from r2flow.model.parts import NOTES
from r2flow.model.tensor_files import read_tensors, read_torch

_R2FLOW = "https://github.com/kazuto1011/r2flow/releases/download/weights"
_BONNETAL = "http://www.ipb.uni-bonn.de/html/projects/bonnetal/lidar/semantic/models"

SOURCES: Registry[str] = Registry(
    "network with published weights",
    rangenet53=f"{_BONNETAL}/darknet53-1024.tar.gz",
    rangenet21=f"{_R2FLOW}/rangenet21_lidm.tar.gz",
    pointnet="https://github.com/microsoft/SpareNet/raw/main/Frechet/cls_model_39.pth",
    minkowskinet=f"{_R2FLOW}/minkowskinet_lidm.tar.gz",
    spvcnn=f"{_R2FLOW}/spvcnn_lidm.tar.gz",
)

# Parameter files in an archive.
_PARTS = ("backbone", "segmentation_decoder", "segmentation_head", "model.ckpt")
Tensors = dict[str, Tensor]  # by name

_LARGEST = 2**31  # maximum file size in bytes; the largest network has 0.2 GB


class Extractor(nn.Module, ABC):
    """A network that computes features of scans, for inference only.

    A subclass defines `features`, and `trained` unless its weights come from `r2flow info --add`.
    """

    name: str  #: name in `r2flow.metrics.extractors.EXTRACTORS`
    layer: str  #: description of the features
    dim: int  #: number of features, D
    needs_reflectance: bool = False  #: whether reflectance is an input
    weights: str = "random"  #: first 12 digits of the SHA-256 of its weights, set where loaded

    @abstractmethod
    def features(self, scans: Scans) -> Tensor:
        """Features (B, D), float32; NaN for a scan without returns."""

    @classmethod
    def from_tensors(cls, tensors: Tensors) -> Self:
        """Build the network from published tensors by name, with sizes from them."""
        return cls().filled(tensors)

    @classmethod
    def trained(cls) -> Self:
        """Load the network with its installed weights, in evaluation mode on the CPU."""
        path = kept_file(cls.name)
        if not path.exists():
            raise InputError(
                f"no weights of {cls.name} in {path.parent}: get "
                f"{PurePosixPath(SOURCES[cls.name]).name} and give r2flow info --add {cls.name} "
                "FILE (r2flow info lists sources)."
            )
        with reading_errors(path):
            extractor = cls.from_tensors(read_tensors(path)[0])
        extractor.weights = weights_hash(extractor)
        return extractor

    def filled(self, tensors: Tensors) -> Self:
        """Load exactly these parameters and switch to evaluation mode."""
        try:
            self.load_state_dict(dict(tensors))
        except RuntimeError as error:
            problem = str(error).splitlines()[1].strip()[:160]
            raise InputError(f"not the weights of {self.name}: {problem}") from None
        return self.requires_grad_(False).eval()

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device


def weights_folder() -> Path:
    """Folder of weights: R2FLOW_WEIGHTS, or ~/.cache/r2flow/weights."""
    return cache_folder("R2FLOW_WEIGHTS", "weights")


def kept_file(name: str) -> Path:
    """File of the installed weights of a network."""
    return weights_folder() / f"{name}.safetensors"


def kept(name: str) -> str | None:
    """Description of the installed weights of a network; None if not installed."""
    path = kept_file(name)
    if not path.exists():
        return None
    with reading_errors(path):
        return read_tensors(path)[1][NOTES]


def add(name: str, path: Path) -> str:
    """Copy weights from a file, or an archive or folder of several files, into their folder.

    Returns the first 12 digits of the SHA-256 of the parameters, independent of the file format.
    """
    SOURCES[name]
    tensors = _read_published(path)
    with reading_errors(path):
        weights = weights_hash(EXTRACTORS[name].from_tensors(tensors))
    whole = {name: tensor.clone().contiguous() for name, tensor in tensors.items()}
    content = save(whole, metadata={NOTES: f"{weights} of {path.name}"})
    write_file(kept_file(name), content)
    return weights


def weights_hash(extractor: Extractor) -> str:
    """First 12 digits of the SHA-256 of a network's parameters and buffers."""
    tensors = dict(extractor.named_parameters()) | dict(extractor.named_buffers())
    return state_hash(tensors)[:12]


def _read_published(path: Path) -> Tensors:
    """Read tensors by name from a file, an archive or a folder."""
    with reading_errors(path) if path.is_dir() else reading(path, _LARGEST, "file of weights"):
        if path.suffix == ".safetensors":
            return read_tensors(path)[0]
        tensors: Tensors = {}
        files = set()
        for name, content in _contents(path):
            if name in files:
                raise InputError(f"it holds several networks ('{name}' twice).")
            files.add(name)
            part = read_torch(io.BytesIO(content), name)
            tensors |= part.get("state_dict", part)
        if not tensors:
            raise InputError(f"it holds none of {', '.join(_PARTS)}; give the published archive.")
        return tensors


def _contents(path: Path) -> Iterator[tuple[str, bytes]]:
    """Names and contents of a file, or of the files of `_PARTS` in a folder or a tar archive."""
    if path.is_dir():
        for name in _PARTS:
            if (path / name).is_file():
                yield name, (path / name).read_bytes()
    elif tarfile.is_tarfile(path):
        with tarfile.open(path) as tar:
            for member in tar:
                name = PurePosixPath(member.name).name
                file = tar.extractfile(member) if member.isreg() and name in _PARTS else None
                if file is not None:
                    yield name, file.read()
    else:
        yield path.name, path.read_bytes()
