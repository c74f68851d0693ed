import errno
import hashlib
import os
import stat
import struct

import pytest
import torch

from r2flow.base.errors import InputError, explain_mistake
from r2flow.base.files import atomic_write
from r2flow.base.hashing import state_hash


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "folder" / "file.txt"
    with atomic_write(path) as file:
        file.write(b"old")
    with pytest.raises(TypeError), atomic_write(path) as file:
        file.writelines([b"half of the new o", None])
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == ["file.txt"]


def test_the_file_has_the_usual_permissions(tmp_path):
    with atomic_write(tmp_path / "ours") as file:
        file.write(b"1")
    (tmp_path / "plain").write_bytes(b"1")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("ours", "plain")]
    assert modes[0] == modes[1]


def test_what_is_no_file_is_refused_by_its_name_and_stays(tmp_path):
    (tmp_path / "out").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name, target in (("link", "pipe"), ("dangling", "nothing")):
        (tmp_path / name).symlink_to(target)
    before = sorted(os.listdir(tmp_path))
    for name, words in (
        ("out", "is a folder"), ("pipe", "is not a regular file"), ("link", "is not a regular file"),
        ("/dev/null", "is not a regular file"),
    ):  # fmt: skip
        with (
            pytest.raises(InputError, match=f"{tmp_path / name} {words}"),
            atomic_write(tmp_path / name),
        ):
            pytest.fail("the block was entered")
    # a disk that is not mounted
    with pytest.raises(FileExistsError), atomic_write(tmp_path / "dangling" / "file"):
        pass
    assert sorted(os.listdir(tmp_path)) == before
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)


@pytest.mark.parametrize("to", ["other/file", "first"])
def test_the_file_that_a_link_leads_to_is_replaced(tmp_path, to):
    target = tmp_path / "other" / "file"
    target.parent.mkdir()
    (tmp_path / "dangling").symlink_to("other/file")
    with atomic_write(tmp_path / "dangling") as file:
        file.write(b"old")
    assert target.read_text() == "old"
    (tmp_path / "first").symlink_to(target)
    (tmp_path / "link").symlink_to(to)
    before = target.stat().st_ino
    with atomic_write(tmp_path / "link") as file:
        file.write(b"new")
    assert target.read_text() == "new"
    assert target.stat().st_ino != before  # replaced as a whole
    assert os.readlink(tmp_path / "link") == to
    assert os.listdir(target.parent) == ["file"]


def test_a_read_only_folder_is_an_error_with_the_file_s_own_name(tmp_path, monkeypatch):
    # Root may write into a read-only folder: what the system says to others is said here by hand.
    def refused(path, *_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr("r2flow.base.files.open", refused, raising=False)
    with pytest.raises(PermissionError) as raised, atomic_write(tmp_path / "out.json"):
        pass
    assert explain_mistake(raised.value) == f"{tmp_path / 'out.json'}: Permission denied"


def test_the_hash_of_a_state_is_of_names_shapes_types_and_bytes():
    state = {
        "b": torch.tensor([1.0, 2.0]).bfloat16(),
        "a": torch.tensor([[1, 2], [3, 4]]).T,
        "c": torch.tensor(0.5),
    }
    named = (
        b"a (2, 2) torch.int64" + struct.pack("<4q", 1, 3, 2, 4)
        + b"b (2,) torch.bfloat16" + bytes.fromhex("803f0040")
        + b"c () torch.float32" + struct.pack("<f", 0.5)
    )  # fmt: skip
    assert state_hash(state) == hashlib.sha256(named).hexdigest()
    assert (
        state_hash(dict(reversed(state.items())), {"k": 1})
        == hashlib.sha256(b'{"k": 1}' + named).hexdigest()
    )
