"""The same flow through torch.hub and the Hugging Face Hub's folders."""

import pickle

import pytest
import torch

import r2flow
from r2flow.errors import InputError
from tests.conftest import ROOT


def test_torch_hub_gives_the_model_of_the_package():
    flow = torch.hub.load(str(ROOT), "street", source="local")
    assert torch.equal(flow.sample(1, steps=1), r2flow.load("street").sample(1, steps=1))


def test_a_folder_for_the_hub_holds_the_flow_and_nothing_else(tmp_path):
    pytest.importorskip("huggingface_hub")
    from r2flow.model.hub import HubFlow

    HubFlow("street").save_pretrained(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"README.md", "model.safetensors"}
    assert str(tmp_path) not in (tmp_path / "README.md").read_text()
    back = HubFlow.from_pretrained(str(tmp_path))
    assert torch.equal(back.sample(1, steps=1), r2flow.load("street").sample(1, steps=1))


class Trap:
    def __reduce__(self):
        return (exec, ("raise SystemExit('a file from the hub was run')",))


def test_nothing_in_such_a_folder_is_unpickled(tmp_path):
    pytest.importorskip("huggingface_hub")
    from r2flow.model.hub import FILE, HubFlow

    for name in ("pytorch_model.bin", "model.pt", "step-00000001.ckpt"):
        (tmp_path / name).write_bytes(pickle.dumps(Trap()))
    with pytest.raises(InputError, match="no checkpoint at"):
        HubFlow.from_pretrained(str(tmp_path))
    (tmp_path / FILE).write_bytes(pickle.dumps(Trap()))
    with pytest.raises(InputError, match="not a readable .safetensors file"):
        HubFlow.from_pretrained(str(tmp_path))


def test_what_from_pretrained_does_not_know_is_refused(tmp_path):
    pytest.importorskip("huggingface_hub")
    from r2flow.model.hub import HubFlow

    HubFlow("street").save_pretrained(tmp_path)
    with pytest.raises(InputError, match="does not know stepps; it takes device, revision"):
        HubFlow.from_pretrained(str(tmp_path), stepps=3)
    with pytest.raises(InputError, match="device must be auto, cpu"):
        HubFlow.from_pretrained(str(tmp_path), device="gpu")
    assert HubFlow.from_pretrained(str(tmp_path), device="auto").checkpoint.generator.space.sensor.name
