"""Feature networks, and the weights of published ones: sources, installation and loading.

r2flow does not download. It reads a file from disk as tensors only, checks it against its network and stores it as
safetensors in the folder of weights, from which `Extractor.trained` loads it.
"""

import io
import json
import tarfile
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import IO, Any, ClassVar, Self

import torch
import yaml
from safetensors.torch import save
from torch import Tensor, nn

from r2flow.errors import InputError, check, naming
from r2flow.files import atomic_write, cache_folder, reading, telling
from r2flow.hashing import state_hash
from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.scans import Scans
from r2flow.model.checkpoint import NOTES, is_dense, read_tensors, read_torch
from r2flow.registry import Registry

R2FLOW = "https://github.com/kazuto1011/r2flow/releases/download/weights/"

SOURCES: Registry[str] = Registry(
    "network with published weights",
    rangenet53="http://www.ipb.uni-bonn.de/html/projects/bonnetal/lidar/semantic/models/darknet53-1024.tar.gz",
    rangenet21=f"{R2FLOW}rangenet21_lidm.tar.gz",
    pointnet="https://github.com/microsoft/SpareNet/raw/main/Frechet/cls_model_39.pth",
    minkowskinet=f"{R2FLOW}minkowskinet_lidm.tar.gz",
    spvcnn=f"{R2FLOW}spvcnn_lidm.tar.gz",
)

# Parameter files in an archive, and its config.
PARTS = ("backbone", "segmentation_decoder", "segmentation_head", "model.ckpt")
CONFIG = "arch_cfg.yaml"
LARGEST = 2**31  # maximum file size in bytes; the largest network has 0.2 GB


class Extractor(nn.Module, ABC):
    """A network that computes features of scans, for inference only.

    A subclass defines `features`, and `trained` unless its weights come from `r2flow weights --add`.
    """

    name: ClassVar[str]  #: name in `r2flow.metrics.extractors.EXTRACTORS`
    layer: ClassVar[str]  #: description of the features
    dim: int  #: number of features, D
    needs_reflectance: ClassVar[bool] = False  #: whether reflectance is an input
    weights: str = "random"  #: first 12 digits of the SHA-256 of its weights, set where they are loaded

    @abstractmethod
    def features(self, scans: Scans) -> Tensor:
        """Features (B, D), float32; NaN for a scan without returns."""

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], config: Mapping[str, Any]) -> Self:
        """Build the network from published tensors by name, with sizes from them; `config` may be empty."""
        return cls().filled(tensors)

    @classmethod
    def trained(cls) -> Self:
        """Load the network with its installed weights, in evaluation mode on the CPU."""
        path = kept_file(cls.name)
        if not path.exists():
            raise InputError(
                f"no weights of {cls.name} in {path.parent}: get {PurePosixPath(SOURCES[cls.name]).name} and give "
                f"r2flow weights --add {cls.name} FILE (r2flow weights lists sources)."
            )
        tensors, notes = _read_safetensors(path)
        extractor = cls.from_tensors(tensors, notes["config"])
        extractor.weights = weights_hash(extractor)
        if extractor.weights != notes["weights"]:
            raise InputError(
                f"{path} is not what was added ({extractor.weights}, not {notes['weights']}); add its weights again."
            )
        return extractor

    def filled(self, tensors: Mapping[str, Tensor]) -> Self:
        """Load exactly these parameters and switch to evaluation mode."""
        # num_batches_tracked is not used in inference; older files lack it.
        counts = {name: value for name, value in self.state_dict().items() if name.endswith("num_batches_tracked")}
        try:
            self.load_state_dict({**counts, **tensors})
        except RuntimeError as error:
            raise InputError(f"not the weights of {self.name}: {str(error).splitlines()[1].strip()[:160]}") from None
        if broken := [name for name, value in self.state_dict().items() if not value.isfinite().all()]:
            raise InputError(f"not the weights of {self.name}: '{broken[0]}' has values that are not finite.")
        return self.requires_grad_(False).eval()

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device


def nan_where_empty(features: Tensor, scans: Scans) -> Tensor:
    """Features (B, D) with NaN for scans without returns."""
    returned = scans.returned.flatten(1).any(1).to(features.device)
    return torch.where(returned[:, None], features, torch.nan)


def weights_folder() -> Path:
    """Folder of weights: R2FLOW_WEIGHTS, or ~/.cache/r2flow/weights."""
    return cache_folder("R2FLOW_WEIGHTS", "weights")


def kept_file(name: str) -> Path:
    return weights_folder() / f"{name}.safetensors"


def kept(name: str) -> str | None:
    """Description of the installed weights of a network; None if not installed."""
    path = kept_file(name)
    if not path.exists():
        return None
    notes = _read_safetensors(path)[1]
    return f"{notes['weights']} of {notes['source']}"


def add(name: str, path: Path) -> str:
    """Copy weights from a file, or an archive or folder of several files, into the folder of weights.

    Returns the first 12 digits of the SHA-256 of the parameters, independent of the file format.
    """
    SOURCES[name]
    tensors, config = read_published(path)
    with naming(path):
        weights = weights_hash(EXTRACTORS[name].from_tensors(tensors, config))
    whole = {name: tensor.contiguous().clone() for name, tensor in tensors.items()}  # tensors may share memory
    notes = json.dumps({"weights": weights, "source": path.name, "config": config}, default=str)
    with atomic_write(kept_file(name)) as file:
        file.write(save(whole, metadata={NOTES: notes}))
    return weights


def weights_hash(extractor: Extractor) -> str:
    """First 12 digits of the SHA-256 of a network's parameters and buffers."""
    return state_hash({**dict(extractor.named_parameters()), **dict(extractor.named_buffers())})[:12]


def read_published(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read tensors by name, and the config, from a file, an archive or a folder."""
    if path.is_dir():
        members = {name: (path / name).read_bytes() for name in (*PARTS, CONFIG) if (path / name).is_file()}
        return _joined(path, members)
    with reading(path, LARGEST, "file of weights"):
        if path.suffix == ".safetensors":
            tensors, notes = _read_safetensors(path)
            return tensors, notes["config"]
        with path.open("rb") as file:
            is_archive = file.read(2) == b"\x1f\x8b" or tarfile.is_tarfile(path)
            return _joined(path, _unpacked(path)) if is_archive else (_read_torch(file, str(path)), {})


def _unpacked(path: Path) -> dict[str, bytes]:
    """The files of `PARTS` and `CONFIG` in a tar archive, by file name."""
    members: dict[str, bytes] = {}
    with tarfile.open(path) as tar:
        for member in tar:
            name = PurePosixPath(member.name).name
            if name in (*PARTS, CONFIG) and (content := tar.extractfile(member) if member.isreg() else None):
                if name in members or member.size > LARGEST:
                    raise InputError(f"{path} holds several networks ('{name}' twice), or a file that is too large.")
                members[name] = content.read()
    return members


def _joined(path: Path, members: Mapping[str, bytes]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    parts = [_read_torch(io.BytesIO(members[part]), f"{path}: {part}") for part in PARTS if part in members]
    check(parts, f"{path} holds none of {', '.join(PARTS)}; give the published archive.")
    with telling(path / CONFIG):
        config = yaml.safe_load(members.get(CONFIG, b"{}"))
        check(isinstance(config, dict), f"{path / CONFIG} is not a table of settings; is the archive whole?")
    return {name: tensor for part in parts for name, tensor in part.items()}, config


def _read_torch(file: IO[bytes], name: str) -> dict[str, Tensor]:
    content = read_torch(file, name)
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    tensors = isinstance(content, dict) and all(isinstance(n, str) and is_dense(value) for n, value in content.items())
    check(tensors and content, f"{name} holds no table of tensors.")
    return content


def _read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    with telling(path):
        tensors, metadata = read_tensors(path)
        return tensors, {"config": {}, "weights": "", "source": path.name, **json.loads(metadata.get(NOTES, "{}"))}
