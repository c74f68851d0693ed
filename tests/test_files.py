import os
import stat

import pytest

from r2flow.errors import explain_mistake
from r2flow.files import atomic_write


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
