import hashlib
import os
import stat
import struct

import pytest
import torch

from r2flow.errors import explain_mistake
from r2flow.files import atomic_write, state_hash


def test_the_file_is_whole_or_the_old_one(tmp_path):
    path = tmp_path / "folder" / "file.txt"
    with atomic_write(path, "w") as file:
        file.write("old")
    with pytest.raises(TypeError), atomic_write(path, "w") as file:
        file.writelines(["half of the new o", None])
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == ["file.txt"]


def test_the_file_is_as_readable_as_any_other(tmp_path):
    with atomic_write(tmp_path / "ours") as file:
        file.write(b"1")
    (tmp_path / "plain").write_bytes(b"1")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("ours", "plain")]
    assert modes[0] == modes[1]


def test_a_folder_in_the_way_is_named_itself(tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(IsADirectoryError) as raised, atomic_write(tmp_path / "out"):
        pass
    assert explain_mistake(raised.value) == f"{tmp_path / 'out'}: is a folder; name a file to write to"
    assert os.listdir(tmp_path) == ["out"]


def test_the_hash_of_a_state_is_of_names_shapes_types_and_bytes():
    state = {"b": torch.tensor([1.0, 2.0]).bfloat16(), "a": torch.tensor([[1, 2], [3, 4]]).T, "c": torch.tensor(0.5)}
    named = (
        b"a (2, 2) torch.int64" + struct.pack("<4q", 1, 3, 2, 4)
        + b"b (2,) torch.bfloat16" + bytes.fromhex("803f0040")
        + b"c () torch.float32" + struct.pack("<f", 0.5)
    )  # fmt: skip
    assert state_hash(state) == hashlib.sha256(named).hexdigest()
    assert state_hash(dict(reversed(state.items())), b"kitti") == hashlib.sha256(b"kitti" + named).hexdigest()
