"""A run goes on with the contents that it began with, wherever they lie, and says the first file that changed."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from r2flow.data import contents
from r2flow.data.contents import RECORD, check_contents, record_contents
from r2flow.data.datamodule import ScanDataModule
from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import SENSORS
from tests.data.conftest import prepare_folder
from tests.training.conftest import TINY, in_process

SENSOR = SENSORS["hdl64e"].resized(8, 64)


@pytest.fixture
def own(scans: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(scans, tmp_path / "scans"))


def mirror(path: Path) -> None:
    """Another scan of the same size under the same name, and of the same time of change."""
    before = path.stat()
    table = np.fromfile(path, np.float32).reshape(-1, 4)
    table[:, 1] *= -1
    table.tofile(path)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size


def files_of(folder: Path, **keys: object) -> dict[str, str | Path]:
    module = ScanDataModule(SENSOR, Encoding(SENSOR), 0, **{"name": "folder", "root": str(folder), **keys})
    module.sources()
    return module.files


def test_a_run_with_changed_scans_is_refused_by_the_name_of_the_first(own: Path, tmp_path: Path):
    given = [*TINY, f"data.root={own}", "name=run", "trainer.max_steps=4", "samples.num=0"]
    run = tmp_path / "runs" / "run"

    def interrupted() -> None:
        """Take the last checkpoint away: the same command has something left to do."""
        (run / "checkpoints" / "step-00000004.ckpt").unlink()

    in_process(tmp_path, given)
    interrupted()
    mirror(own / "000003.bin")
    mirror(own / "000005.bin")
    done = in_process(tmp_path, given, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == (
        f"error: {own}/000003.bin has changed since runs/run began to train on it. Give back the scans that it began "
        "with, or take name=OTHER for a new run."
    )
    (run / RECORD).unlink()  # a run of an older version has none: it goes on, and is watched from then on
    in_process(tmp_path, given)
    interrupted()
    mirror(own / "000003.bin")
    assert in_process(tmp_path, given, check=False).returncode == 2


def test_scans_may_be_copied_elsewhere_and_touched(own: Path, tmp_path: Path):
    record_contents(tmp_path, files_of(own))
    moved = shutil.copytree(own, tmp_path / "moved", copy_function=shutil.copyfile)
    for path in moved.iterdir():
        os.utime(path)
    check_contents(tmp_path, files_of(moved))
    mirror(moved / "000011.bin")  # which is held out
    with pytest.raises(InputError, match=r"moved/000011\.bin has changed"):
        check_contents(tmp_path, files_of(moved))


def test_of_many_files_sizes_and_times_are_compared(own: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(contents, "MOST_READ", 1000)
    record_contents(tmp_path, files_of(own))
    check_contents(tmp_path, files_of(own))
    os.utime(own / "000011.bin")
    with pytest.raises(InputError, match=r"000011\.bin has changed .* copied alone, remove .*files\.json"):
        check_contents(tmp_path, files_of(own))


def test_prepared_scans_and_those_held_out_elsewhere_are_watched_too(own: Path, tmp_path: Path):
    def prepare() -> None:
        prepare_folder(own, tmp_path / "prepared", SENSOR)

    prepare()
    other = Path(shutil.copytree(own, tmp_path / "other"))
    keys = {
        "name": "prepared",
        "root": str(tmp_path / "prepared"),
        "validation": {"data": {"name": "folder", "root": str(other)}},
    }
    record_contents(tmp_path, files_of(own, **keys))
    check_contents(tmp_path, files_of(own, **keys))
    mirror(other / "000007.bin")
    with pytest.raises(InputError, match=r"other/000007\.bin has changed"):
        check_contents(tmp_path, files_of(own, **keys))
    mirror(other / "000007.bin")
    shutil.rmtree(tmp_path / "prepared")
    mirror(own / "000005.bin")
    prepare()
    with pytest.raises(InputError, match=r"prepared/scans-000000\.safetensors has changed"):
        check_contents(tmp_path, files_of(own, **keys))


def test_parts_of_a_mixture_may_have_files_of_one_name(own: Path, tmp_path: Path):
    other = Path(shutil.copytree(own, tmp_path / "other"))
    keys = {"name": "mixed", "parts": [{"name": "folder", "root": str(root)} for root in (own, other)]}
    record_contents(tmp_path, files_of(own, **keys))
    mirror(own / "000002.bin")
    with pytest.raises(InputError, match=r"scans/000002\.bin has changed"):
        check_contents(tmp_path, files_of(own, **keys))


def test_a_damaged_note_is_written_again_and_pipes_are_not_read(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.bin")
    files = {"pipe.bin": tmp_path / "pipe.bin", "zero.bin": "/dev/zero", "missing.bin": tmp_path / "missing.bin"}
    for text in ("", "{", "[]", '{"by": "contents", "files": 3}'):
        (tmp_path / RECORD).write_text(text)
        check_contents(tmp_path, files)
        check_contents(tmp_path, files)
    (tmp_path / "missing.bin").write_bytes(b"now")
    with pytest.raises(InputError, match="missing"):
        check_contents(tmp_path, files)
