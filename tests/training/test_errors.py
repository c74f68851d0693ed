"""What a user gets wrong: one line that names it, exit code 2, nothing written."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.training.conftest import Run


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["bakcbone.base_channels=8"], ["no key 'bakcbone.base_channels'", "Did you mean 'backbone.base_channels'?"]),
        (["backbone=hditt"], ["no backbone config named 'hditt'", "Did you mean 'hdit'?"]),
        (["+backbone.widht=8"], ["no option 'widht'"]),
        (["+data.rot=8"], ["no option 'rot'", "Did you mean 'root'?"]),
        (["stage.loss=l3"], ["no loss named 'l3'", "mse"]),
        (["sensor.columns=100"], ["100", "nearest"]),
        (["data.root=/nowhere/at/all"], ["/nowhere/at/all is not a folder", "data.root=FOLDER"]),
        (["data.batch_size=3", "trainer.accumulate_grad_batches=2"], ["batch_size=3", "multiple of 2"]),
        (["trainer.precision=16-mixed"], ["16-mixed", "bf16-mixed"]),
        (["trainer.max_steps=abc"], ["max_steps must be a whole number", "'abc'"]),
        (["encoding.format=log"], ["no range format named 'log'", "Did you mean 'logscale'?"]),
        (["encoding.reflectance=maybe"], ["reflectance must be true, false or auto", "'maybe'"]),
        (["sensor.rays=foo"], ["'centre' or 'reference'", "'foo'"]),
        (["stage.time.name=discrete"], ["needs the option 'k'"]),
        (["+data.validation.data={name: folder, root: x, splt: test}"], ["no option 'splt'", "Did you mean 'split'?"]),
        (["loggers=csv"], ["loggers=[csv]"]),
        (["data.augment.roll=true"], ["data.augment.roll", "backbone.position=learnable", "backbone.position=none"]),
        (["data.augment.ray_dropout=1.5"], ["data.augment: ray_dropout must be a finite number in [0, 1)", "1.5"]),
        (["data=mixed", "data.parts=[{name: folder, rot: x}]"], ["data.parts[0] has no option 'rot'", "'root'"]),
        (["data.validation.data={name: mixed}"], ["needs the name of a data set"]),
    ],
)
def test_wrong_config(train: Run, tmp_path: Path, overrides: list[str], words: list[str]):
    done = train("name=bad", *overrides, check=False)
    assert done.returncode == 2
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0]
    assert list(tmp_path.iterdir()) == []


def test_an_empty_root(train: Run, tmp_path: Path):
    (tmp_path / "empty").mkdir()
    done = train(f"data.root={tmp_path / 'empty'}", check=False)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert "empty holds no scan" in done.stderr


def test_one_bad_scan_stops_the_run_or_is_left_out(train: Run, scans: Path, tmp_path: Path):
    folder = tmp_path / "copy"
    folder.mkdir()
    for path in scans.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "000004.bin").write_bytes(b"\0" * 33)
    done = train(f"data.root={folder}", "name=strict", check=False)
    assert done.returncode == 2
    for words in ("000004.bin", "data.reading.on_bad_scan=skip"):
        assert words in done.stderr.strip().splitlines()[-1]
    done = train(f"data.root={folder}", "name=lenient", "data.reading.on_bad_scan=skip", "trainer.max_steps=2")
    assert "left out" in done.stdout + done.stderr
    assert (tmp_path / "runs" / "lenient" / "checkpoints").exists()


@pytest.mark.parametrize("mistake", ["bakcbone.base_channels=8", "backbone=hditt", "chain=[", "+experiment=reflo"])
def test_a_misspelt_config_is_answered_without_loading_torch(tmp_path: Path, mistake: str):
    script = f"import sys; from r2flow.runs.launch import main; print(main([{mistake!r}], []), 'torch' in sys.modules)"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
    assert done.stdout == "2 False\n", done.stderr
    assert len(done.stderr.splitlines()) == 1
