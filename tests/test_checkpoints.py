import pickle
from pathlib import Path

import pytest
import torch

from r2flow.checkpoints import AtomicCheckpointIO, checkpoints_of, load_checkpoint
from r2flow.errors import InputError
from r2flow.stages import build_parts, build_stage

CONFIG = {
    "sensor": {"name": "hdl64e", "rows": 8, "columns": 64, "rays": "centre"},
    "encoding": {"format": "logscale", "reflectance": True},
    "backbone": {"name": "hdit", "base_channels": 8, "depths": [1, 1], "num_heads": [1, 2], "time_channels": 16},
    "data": {"name": "simulated", "batch_size": 4},
    "stage": {"name": "rectify"},
    "seed": 0,
}


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Path, dict]:
    """A checkpoint of ours with random weights, averaged and raw, and the averaged ones."""
    stage = build_stage(CONFIG, build_parts(CONFIG).backbone)
    parameters = dict(stage.named_parameters())
    raw = {name: torch.randn_like(v) if name in parameters else v for name, v in stage.state_dict().items()}
    averaged = {name: v + 1 if name in parameters else v for name, v in raw.items()}
    content = {"state_dict": averaged, "current_model_state": raw, "config": CONFIG, "global_step": 7}
    path = tmp_path / "run" / "checkpoints" / "step-00000007.ckpt"
    AtomicCheckpointIO().save_checkpoint(content, path)
    return path, averaged


def test_the_averaged_weights_are_the_model(saved):
    path, averaged = saved
    for given in (path, path.parent, path.parent.parent):
        loaded = load_checkpoint(given)
        assert loaded.step == 7
        assert loaded.format == "r2flow"
        assert loaded.sensor.shape == (8, 64)
        assert not loaded.model.training
        for name, value in loaded.model.state_dict().items():
            assert torch.equal(value, averaged[f"velocity.{name}"])
    for name, value in load_checkpoint(path, averaged=False).model.named_parameters():
        assert torch.equal(value + 1, averaged[f"velocity.{name}"])


def test_the_newest_of_a_run_is_taken(saved):
    path, _ = saved
    newer = path.with_name("step-00000010.ckpt")
    newer.write_bytes(path.read_bytes())
    assert checkpoints_of(path.parent.parent) == [newer, path]


def test_a_published_checkpoint_computes_what_its_authors_did(shared):
    loaded = load_checkpoint(shared / "oracle" / "published_format.pth")
    case = torch.load(shared / "oracle" / "hdit_16x192.pt", weights_only=False)
    assert loaded.format == "published"
    assert loaded.sensor.shape == (16, 192)
    with torch.no_grad():
        output = loaded.model(case["t"], case["x"])
    assert (output - case["output"]).norm() / case["output"].norm() < 5e-5


class Malicious:
    def __reduce__(self):
        return (Path.touch, (Path("touched-by-a-checkpoint"),))


def test_a_file_that_would_run_code_is_refused(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": Malicious()}, tmp_path / "evil.ckpt")
    with pytest.raises(InputError, match=r"evil.ckpt is refused: it holds objects that would run code"):
        load_checkpoint(tmp_path / "evil.ckpt")
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(Malicious()))
    with pytest.raises(InputError, match="evil.pkl"):
        load_checkpoint(tmp_path / "evil.pkl")
    assert not (tmp_path / "touched-by-a-checkpoint").exists()


@pytest.mark.parametrize("content", [b"", b"hello", b"\x80\x04N.", b"PK\x03\x04" + b"\0" * 100])
def test_what_is_no_checkpoint_says_so(tmp_path: Path, content: bytes):
    path = tmp_path / "thing.ckpt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"thing.ckpt is not a checkpoint, or a damaged one"):
        load_checkpoint(path)


def test_a_cut_or_flipped_checkpoint_is_an_error_or_whole(saved):
    path, _ = saved
    whole = path.read_bytes()
    for end in range(0, len(whole) - 1, len(whole) // 40):
        path.write_bytes(whole[:end])
        with pytest.raises(InputError, match="step-00000007"):
            load_checkpoint(path)


def test_missing_files_and_other_torch_files(tmp_path: Path):
    with pytest.raises(InputError, match="no checkpoint at"):
        load_checkpoint(tmp_path / "missing.ckpt")
    with pytest.raises(InputError, match="holds no checkpoint"):
        load_checkpoint(tmp_path)
    torch.save({"weight": torch.zeros(3)}, tmp_path / "weights.pt")
    with pytest.raises(InputError, match=r"neither 'config' and 'state_dict' \(ours\) nor .* found 'weight'"):
        load_checkpoint(tmp_path / "weights.pt")


def test_weights_that_do_not_fit_name_the_first(saved):
    path, averaged = saved
    name = next(iter(averaged))
    changed = {**averaged, name: torch.zeros(3)}
    AtomicCheckpointIO().save_checkpoint({"state_dict": changed, "config": CONFIG}, path)
    with pytest.raises(InputError, match="has shape"):
        load_checkpoint(path)
    del changed[name]
    AtomicCheckpointIO().save_checkpoint({"state_dict": changed, "config": CONFIG}, path)
    with pytest.raises(InputError, match="1 names missing"):
        load_checkpoint(path)


def test_saving_is_whole_or_not_at_all(saved, monkeypatch):
    path, _ = saved
    before = path.read_bytes()

    def full_disk(content, file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(OSError, match="No space left"):
        AtomicCheckpointIO().save_checkpoint({}, path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]
