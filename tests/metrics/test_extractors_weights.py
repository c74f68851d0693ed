import io
import os
import signal
import subprocess
import sys
import tarfile

import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.extractors.base import SOURCES, _read_published, add, kept, weights_hash
from r2flow.metrics.extractors.pointnet import PointNet
from tests.metrics.conftest import untrained

PARTS = {
    "backbone": {"conv1.weight": torch.ones(2)},
    "segmentation_decoder": {"dec5.upconv.bias": torch.zeros(3)},
    "segmentation_head": {"1.bias": torch.ones(1)},
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("R2FLOW_WEIGHTS", str(tmp_path / "kept"))
    return tmp_path / "kept"


@pytest.fixture
def pointnet(tmp_path):
    network = untrained(PointNet, 3)
    path = tmp_path / "cls_model_39.pth"
    torch.save(network.state_dict(), path)
    return network, path


def saved(content) -> bytes:
    stream = io.BytesIO()
    torch.save(content, stream)
    return stream.getvalue()


def pack(folder, kind):
    """The release's files as a folder or a .tar.gz, one folder deep as they are published."""
    files = {name: saved(content) for name, content in PARTS.items()} | {
        "arch_cfg.yaml": b"date: 2020-01-01"
    }
    if kind == "folder":
        for name, data in files.items():
            (folder / name).write_bytes(data)
        return folder
    path = folder / f"darknet53-1024.{kind}"
    with tarfile.open(path, "w:gz") as tar:
        for name, data in files.items():
            info = tarfile.TarInfo(f"darknet53-1024/{name}")
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
        link = tarfile.TarInfo("darknet53-1024/model.ckpt")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(link)
    return path


def test_every_network_says_where_its_weights_are_got(folder):
    assert (
        set(SOURCES)
        == {"rangenet53", "rangenet21", "pointnet", "minkowskinet", "spvcnn"}
        <= set(EXTRACTORS)
    )
    for name, page in SOURCES.items():
        assert page.startswith("http")
        assert kept(name) is None
        assert EXTRACTORS[name].name == name
        with pytest.raises(
            InputError, match=f"no weights of {name} in {folder}.*r2flow info --add {name} FILE"
        ):
            EXTRACTORS[name].trained()
    with pytest.raises(InputError, match="no extractor named 'pointnett'"):
        EXTRACTORS["pointnett"].trained()


def test_weights_that_are_added_are_those_that_are_loaded(pointnet, folder):
    network, path = pointnet
    weights = add("pointnet", path)
    assert kept("pointnet") == f"{weights} of {path.name}"
    loaded = EXTRACTORS["pointnet"].trained()
    assert loaded.weights == weights == weights_hash(network)
    x = torch.randn(1, 3, 50)
    assert torch.equal(loaded(x), network(x))
    assert not loaded.training
    # the hash is the weights', not the file's
    torch.save({"state_dict": network.state_dict(), "epoch": 39}, path)
    assert add("pointnet", path) == weights
    assert add("pointnet", folder / "pointnet.safetensors") == weights
    tensors = {
        name: value for name, value in network.state_dict().items() if "num_batches" not in name
    }
    torch.save(tensors, path)  # counts that old files lack are not asked for
    assert add("pointnet", path) == weights
    assert weights_hash(untrained(PointNet, 4)) != weights


def test_damaged_weights_are_not_used(pointnet, folder):
    network, path = pointnet
    add("pointnet", path)
    kept_path = folder / "pointnet.safetensors"
    kept_path.write_bytes(kept_path.read_bytes()[:-100])
    with pytest.raises(InputError, match="damaged"):
        EXTRACTORS["pointnet"].trained()


def test_weights_of_another_network_are_refused_in_a_line(tmp_path, pointnet, folder):
    network, path = pointnet
    with pytest.raises(
        InputError, match=rf"{path}: not the weights of rangenet21: .*stem.0.weight"
    ):
        add("rangenet21", path)
    tensors = network.state_dict()
    refused = [
        (
            saved({**tensors, "fc3.weight": torch.zeros(40, 256), "fc3.bias": torch.zeros(40)}),
            "size mismatch for fc3",
        ),
    ]
    odd = (
        {0: torch.ones(1)},
        {"a": torch.eye(2).to_sparse()},
        {"a": torch.ones(1) * 1j},
        {"a": 1},
        [1],
    )
    odd += ({"a": torch.ones(1, device="meta")},)
    none = (b"", b"\x80\x02}q\x00.", b"nonsense" * 100, *map(saved, odd))
    refused += [(one, "not a checkpoint|not the weights|not a readable|is empty") for one in none]
    for content, said in refused:
        path.write_bytes(content)
        with pytest.raises(InputError, match=said):
            add("pointnet", path)
    with pytest.raises(InputError, match="does not exist"):
        add("pointnet", tmp_path / "none")
    with pytest.raises(InputError, match="no network with published weights named 'embeded'"):
        add("embeded", path)
    assert not folder.exists()


@pytest.mark.parametrize("kind", ["folder", "tar.gz"])
def test_the_release_of_several_files_is_read_as_one(tmp_path, kind):
    tensors = _read_published(pack(tmp_path, kind))
    expected = {name: value for part in PARTS.values() for name, value in part.items()}
    assert {name: value.tolist() for name, value in tensors.items()} == {
        n: v.tolist() for n, v in expected.items()
    }


def test_archives_of_nothing_of_several_and_of_halves_are_said(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds none of backbone"):
        _read_published(tmp_path / "empty")
    (tmp_path / "model.ckpt").write_bytes(saved(PARTS["backbone"]))
    with tarfile.open(tmp_path / "two.tar.gz", "w:gz") as tar:
        for folder in ("kitti", "nuscenes"):
            tar.add(tmp_path / "model.ckpt", f"{folder}/spvcnn/model.ckpt")
    with pytest.raises(InputError, match=r"several networks \('model.ckpt' twice\)"):
        _read_published(tmp_path / "two.tar.gz")
    path = pack(tmp_path, "tar.gz")
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match="damaged"):
        _read_published(path)


def test_pipes_and_devices_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.pth")
    os.mkfifo(tmp_path / "pipe.safetensors")
    (tmp_path / "zero.tar.gz").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "folder" / "model.ckpt")
    signal.alarm(5)
    try:
        for name in ("pipe.pth", "pipe.safetensors", "zero.tar.gz"):
            with pytest.raises(InputError, match="not a regular file"):
                add("pointnet", tmp_path / name)
        with pytest.raises(InputError, match="holds none of"):
            add("pointnet", tmp_path / "folder")
    finally:
        signal.alarm(0)


def test_the_table_says_which_weights_are_here(r2flow, pointnet, folder):
    def here() -> set[str]:
        said = r2flow("info").said
        for words in (
            "FRD",
            "FRID",
            "FPD",
            "FSVD",
            "FPVD",
            "darknet53-1024.tar.gz",
            f"Looked for in {folder}",
        ):
            assert words in said
        rows = [line.split() for line in said.splitlines() if line.split(" ")[0] in SOURCES]
        assert len(rows) == len(SOURCES)
        return {row[0] for row in rows if row[2] != "no"}

    assert here() == set()
    said = r2flow("info", "--add", "pointnet", pointnet[1]).said
    assert said.startswith(f"{folder / 'pointnet.safetensors'}: weights ")
    assert said.endswith("of cls_model_39.pth\n")
    assert here() == {"pointnet"}
    assert f"{said.split(': weights ')[1].split()[0]} of cls_model_39.pth" in r2flow("info")[1]


def test_the_table_of_networks_is_light():
    code = "import sys, r2flow.metrics.extractors; sys.exit(any(m in sys.modules for m in ('torch', 'torchmetrics')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
