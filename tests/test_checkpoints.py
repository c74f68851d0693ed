import json
import math
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import safetensors.torch
import torch
from r2flow.callbacks.checkpoints import AtomicCheckpointIO

from r2flow.base.errors import InputError
from r2flow.generators import build_generator
from r2flow.lidar.encoding import build_space
from r2flow.model.checkpoint import Checkpoint, check_weights, load_checkpoint
from r2flow.model.published import published_config
from r2flow.model.saving import save_checkpoint
from r2flow.model.tensor_files import read_checkpoint
from tests.conftest import CONFIG, Trap, refused, small_disk


def test_the_averaged_weights_are_the_model(saved):
    path, averaged = saved
    for given in (path, path.parent, path.parent.parent):
        loaded = load_checkpoint(given)
        assert loaded.step == 7
        assert loaded.format == "r2flow"
        assert loaded.sensor.shape == (8, 64)
        assert not loaded.generator.backbone.training
        for name, value in loaded.generator.backbone.state_dict().items():
            assert torch.equal(value, averaged[f"generator.backbone.{name}"])
    for name, value in load_checkpoint(path, averaged=False).generator.backbone.named_parameters():
        assert torch.equal(value + 1, averaged[f"generator.backbone.{name}"])


def test_a_published_checkpoint_computes_what_its_authors_did(shared):
    loaded = load_checkpoint(shared / "oracle" / "published_format.pth")
    case = torch.load(shared / "oracle" / "hdit_16x192.pt", weights_only=False)
    assert (loaded.format, loaded.config.stage.name) == ("published", "rectify")
    assert loaded.sensor.shape == (16, 192)
    with torch.no_grad():
        output = loaded.model(case["t"], case["x"])
    assert (output - case["output"]).norm() / case["output"].norm() < 5e-5


def test_torch_s_default_type_and_modes_change_nothing(saved, request):
    request.addfinalizer(lambda: torch.set_default_dtype(torch.float32))
    expected = load_checkpoint(saved[0]).sample(2, steps=1)
    torch.set_default_dtype(torch.bfloat16)
    with torch.inference_mode():
        flow = load_checkpoint(saved[0])
    assert torch.equal(flow.sample(2, steps=1), expected)
    assert not any(weight.is_inference() for weight in flow.generator.parameters())


def test_a_run_goes_on_without_the_gpu_that_it_began_on(saved, monkeypatch):
    path, averaged = saved
    content = torch.load(path, weights_only=True)
    # as a GPU's run writes it
    monkeypatch.setattr(torch.serialization, "location_tag", lambda storage: "cuda:0")
    AtomicCheckpointIO().save_checkpoint(content, path)
    monkeypatch.undo()
    found = AtomicCheckpointIO().load_checkpoint(path)["state_dict"]
    assert all(torch.equal(value, averaged[name]) for name, value in found.items())


def test_a_file_that_would_run_code_is_refused(tmp_path: Path):
    torch.save({"state_dict": Trap()}, tmp_path / "evil.ckpt")
    with pytest.raises(
        InputError, match=r"evil.ckpt is refused: it holds objects that would run code"
    ):
        load_checkpoint(tmp_path / "evil.ckpt")
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(InputError, match="evil.pkl"):
        load_checkpoint(tmp_path / "evil.pkl")


@pytest.mark.parametrize("content", [b"", b"hello", b"\x80\x04N.", b"PK\x03\x04" + b"\0" * 100])
def test_what_is_no_checkpoint_says_so(tmp_path: Path, content: bytes):
    path = tmp_path / "thing.ckpt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"thing.ckpt is not a checkpoint, or a damaged one"):
        load_checkpoint(path)


def test_compressed_tensors_are_refused_before_they_are_unpacked(saved):
    """torch writes storages as they are, and reads deflated ones: a file of 34 MB can hold 6 GiB."""
    path, _ = saved
    with zipfile.ZipFile(path) as whole:
        entries = [(entry, whole.read(entry)) for entry in whole.infolist()]
    with zipfile.ZipFile(path, "w") as packed:
        for entry, data in entries:
            packed.writestr(entry.filename, data, zipfile.ZIP_DEFLATED)
    assert torch.load(path, weights_only=True)["global_step"] == 7
    with pytest.raises(InputError, match="compressed"):
        load_checkpoint(path)


@pytest.mark.parametrize("bit", [0, 6])
def test_a_flipped_bit_is_found(saved, tmp_path: Path, bit: int):
    path, _ = saved
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as whole:
        tensors = [entry for entry in whole.infolist() if "/data/" in entry.filename]
        largest = max(tensors, key=lambda entry: entry.file_size)
        stored = whole.read(largest)
    content[content.index(stored) + largest.file_size // 2] ^= 1 << bit
    (tmp_path / "flipped.ckpt").write_bytes(content)
    torch.load(tmp_path / "flipped.ckpt", weights_only=True)  # which does not see it
    for read in (load_checkpoint, read_checkpoint):
        with pytest.raises(
            InputError, match=r"flipped.ckpt is damaged: the checksum of .* differs"
        ):
            read(tmp_path / "flipped.ckpt")


@pytest.mark.parametrize(
    "notes", [json.dumps({"config": CONFIG, "step": math.inf}), "[" * 100_000, "[]", "3"]
)
def test_notes_without_end_or_of_another_kind_are_refused(tmp_path: Path, notes: str):
    path = tmp_path / "model.safetensors"
    safetensors.torch.save_file({"x": torch.zeros(1)}, path, metadata={"r2flow": notes})
    with pytest.raises(InputError, match=r"not a model of r2flow, or damaged|Is it damaged"):
        load_checkpoint(path)


def test_missing_files_and_other_torch_files(tmp_path: Path):
    with pytest.raises(InputError, match=f"no checkpoint at .* Did you mean '{tmp_path.name}'"):
        load_checkpoint(f"{tmp_path}s")
    with pytest.raises(InputError, match="holds no checkpoint"):
        load_checkpoint(tmp_path)
    torch.save({"weight": torch.zeros(3)}, tmp_path / "weights.pt")
    with pytest.raises(
        InputError, match=r"neither 'hyper_parameters' and 'r2flow' .* found 'weight'"
    ):
        load_checkpoint(tmp_path / "weights.pt")


@pytest.mark.parametrize(
    "changed",
    [
        *({"hyper_parameters": value} for value in (None, [], "x", {})),
        *({"hyper_parameters": {"sensor": "x"}}, {"hyper_parameters": {"backbone": None}}),
        *({"datamodule_hyper_parameters": value} for value in (5, "x")),
        *(
            {"state_dict": value}
            for value in (None, {"generator.backbone.x": 3}, {1: torch.zeros(1)}, {})
        ),
        *({"global_step": value} for value in ("abc", None, math.inf, math.nan)),
        *({"r2flow": value} for value in (None, [], "x", {})),
        *({"r2flow": {"sampler": value}} for value in ([1], "x", {"steps": {}})),
    ],
)
def test_entries_of_another_kind_are_refused_in_one_line(saved, changed: dict):
    """As checkpoints of other modules and programs have them."""
    path, _ = saved
    content = torch.load(path, weights_only=True)
    for key, value in changed.items():
        part_of = key in ("hyper_parameters", "r2flow") and isinstance(value, dict) and value
        content[key] = {**content[key], **value} if part_of else value
    torch.save(content, path)
    with refused(path):
        load_checkpoint(path)


@pytest.mark.parametrize("kind", [torch.int8, torch.complex64, "sparse", math.nan, -math.inf])
def test_weights_that_are_no_plain_numbers_are_refused(saved, kind):
    path, averaged = saved
    name = max(averaged, key=lambda one: averaged[one].numel())
    value = averaged[name].to_sparse() if kind == "sparse" else averaged[name].clone()
    if isinstance(kind, float):
        value.view(-1)[-1] = kind
    elif kind != "sparse":
        value = value.to(kind)
    torch.save(
        {**torch.load(path, weights_only=True), "state_dict": {**averaged, name: value}}, path
    )
    with pytest.raises(InputError, match=name.removeprefix("generator.")):
        load_checkpoint(path)


def test_weights_that_do_not_fit_name_the_first(saved):
    path, averaged = saved
    content = torch.load(path, weights_only=True)
    (name, _), *others = averaged.items()
    for changed, problem in (
        ({**averaged, name: torch.zeros(3)}, "has shape"),
        (dict(others), "1 names missing"),
    ):
        torch.save({**content, "state_dict": changed}, path)
        with pytest.raises(InputError, match=problem):
            load_checkpoint(path)


def test_a_full_disk_is_one_line_and_loses_nothing(saved):
    path, _ = saved
    before = path.read_bytes()
    with (
        small_disk(50_000),
        pytest.raises(InputError, match=r"step-00000007.ckpt cannot be written.* are intact"),
    ):
        AtomicCheckpointIO().save_checkpoint({"x": torch.randn(100_000)}, path)
    with (
        small_disk(50_000),
        pytest.raises(InputError, match=r"cannot be written: [^.]*\. Fix this"),
    ):
        AtomicCheckpointIO().save_checkpoint(
            {"x": torch.randn(100_000)}, path.parent.parent / "new" / path.name
        )
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_published_weights_are_kept_bit_by_bit(shared, tmp_path: Path):
    published = load_checkpoint(shared / "oracle" / "published_format.pth")
    save_checkpoint(published, tmp_path / "ours.safetensors")
    ours = load_checkpoint(tmp_path / "ours.safetensors")
    assert (ours.format, ours.step) == ("r2flow", published.step)
    torch.testing.assert_close(
        ours.generator.state_dict(), published.generator.state_dict(), rtol=0, atol=0
    )
    with pytest.raises(InputError, match="safetensors"):
        save_checkpoint(published, tmp_path / "model.pth")


def test_an_unfolding_distilled_checkpoint_brings_its_ring_angles_and_steps(shared, tmp_path: Path):
    content = torch.load(shared / "oracle" / "published_format.pth", weights_only=True)
    content["cfg"]["data"]["projection"] = "unfolding-192"
    content["cfg"]["finetuning"]["k_distil"] = 2  # as the published code writes it for a 2-TD
    rings = torch.tensor([2.0 - 1.7 * h - 0.01 * h**2 for h in range(16)]).deg2rad()
    content["weights"]["coords"][0, 0] = rings[:, None]
    torch.save(content, tmp_path / "unfolding.pth")
    loaded = load_checkpoint(tmp_path / "unfolding.pth")
    torch.testing.assert_close(loaded.sensor.rays()[0, :, 0], rings, rtol=0, atol=1e-6)
    torch.testing.assert_close(loaded.generator.backbone.coords[0, 0, :, 0], rings, rtol=0, atol=0)
    assert (
        loaded.generator.sampler.steps,
        loaded.generator.fixed,
        loaded.config.stage.options["steps"],
    ) == (2, True, 2)


def test_published_rows_of_any_number_divide_the_view_evenly(shared):
    cfg = torch.load(shared / "oracle" / "published_format.pth", weights_only=True)["cfg"]
    assert published_config({**cfg, "finetuning": None})["stage"] == {}  # older files do not say it
    for rows in (16, 64, 100, 128):
        cfg["data"]["resolution"] = (rows, 64)
        space = build_space(published_config(cfg))
        # of the network, and of the projection
        edges = 3 - 28 * torch.arange(rows + 1, dtype=torch.float64) / rows
        torch.testing.assert_close(
            space.rays[0, :, 0].rad2deg().double(), edges[:-1], rtol=0, atol=1e-5
        )
        torch.testing.assert_close(
            torch.from_numpy(space.sensor.row_edges), edges, rtol=0, atol=1e-12
        )


def test_loading_and_sampling_import_nothing_that_they_do_not_need(saved):
    code = f"""
import sys
from hubconf import dependencies
from r2flow.model.checkpoint import load_checkpoint

assert load_checkpoint({str(saved[0])!r}).sample(1, steps=2).shape == (1, 2, 8, 64)
assert {{"filelock", "numpy", "rich", "scipy", "typer", "omegaconf"}} & sys.modules.keys() <= {{*dependencies}}
import r2flow.cli.verbs
heavy = "lightning", "tensorboard", "matplotlib", "torchmetrics", "hydra", "torchdiffeq", "sympy", "torch._dynamo"
print([name for name in heavy if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_buffer_may_be_infinite_as_the_mask_of_an_attention_is():
    network = torch.nn.Linear(1, 1)
    network.register_buffer("mask", torch.tensor(-math.inf))
    check_weights(network, network.state_dict())


def test_what_was_trained_without_a_run_is_saved_and_loaded(tmp_path: Path):
    config = {key: CONFIG[key] for key in ("sensor", "encoding", "backbone")}
    mine = Checkpoint(build_generator(config).eval(), config)
    # a plug-in may tie them
    mine.model.mid_levels[0].residual_ffn.adarms = mine.model.mid_levels[0].residual_attn.norm
    mine.save(tmp_path / "mine-step-1.safetensors")
    loaded = load_checkpoint(tmp_path / "mine-step-1.safetensors")
    names = mine.generator.state_dict().keys()
    torch.testing.assert_close(
        loaded.generator.state_dict(), mine.generator.state_dict(), rtol=0, atol=0
    )
    assert loaded.config.stored == config
    mine.generator.backbone = torch.compile(mine.generator.backbone)
    for half in (False, True):
        save_checkpoint(mine, tmp_path / "compiled.safetensors", half)
        assert (
            load_checkpoint(tmp_path / "compiled.safetensors").generator.state_dict().keys()
            == names
        )
    max(mine.generator.parameters(), key=torch.Tensor.numel).data.fill_(1e5)
    with pytest.raises(InputError, match="float16"):
        save_checkpoint(mine, tmp_path / "compiled.safetensors", half=True)
    assert repr(loaded) == "Checkpoint(mine-step-1, rectified_flow, 8x64 hdl64e, step 0)"
