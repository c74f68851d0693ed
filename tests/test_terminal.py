"""What reaches a terminal or a pipe, and how a program ends whose reader, locale or peer is gone."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import r2flow.training
from r2flow.errors import InputError
from r2flow.model.checkpoint import load_checkpoint, save_checkpoint
from tests.training.conftest import scans, tiny  # noqa: F401  a fixture

R2FLOW = [sys.executable, "-m", "r2flow.cli"]


def one_line_of(arguments: list[str], cwd: Path) -> tuple[str, int, str]:
    """The first line, exit code and standard error of a command whose reader ends after that line, as `head -1`."""
    command = [*R2FLOW, *arguments]
    with subprocess.Popen(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        line = process.stdout.readline()
        process.stdout.close()
        error = process.stderr.read()
    return line, process.returncode, error


def test_a_training_outlives_the_reader_of_its_output(tmp_path: Path, scans: Path):  # noqa: F811
    more = ["trainer.max_steps=20", "callbacks.progress.seconds=0", "samples.num=0", "run_dir=run"]
    line, code, error = one_line_of(["train", *tiny(scans, *more)], tmp_path)
    assert line
    assert (code, "Error" in error) == (0, False)
    assert (tmp_path / "run" / "checkpoints" / "step-00000020.ckpt").is_file()


def test_info_ends_quietly_with_its_reader(tmp_path: Path, saved):
    line, code, error = one_line_of(["info", str(saved[0])], tmp_path)
    assert line.startswith("path")
    assert (code, error) == (0, "")


def test_a_name_is_read_as_utf_8_in_every_locale(tmp_path: Path):
    variables = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [*R2FLOW, "train", "run_dir='rün'", "--cfg", "job"]
    done = subprocess.run(command, cwd=tmp_path, env=variables, capture_output=True, check=True)
    assert "run_dir: rün" in done.stdout.decode()


def test_a_name_does_not_control_the_terminal(r2flow, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, error = r2flow("info", "a\033[31mb")
    assert code == 2
    assert "\033" not in error
    assert r"a\x1b[31mb" in error


def test_weights_that_are_not_finite_are_named(r2flow, saved, tmp_path: Path):
    loaded = load_checkpoint(saved[0])
    name, parameter = next(iter(loaded.generator.named_parameters()))
    with torch.no_grad():
        parameter.view(-1)[0] = torch.nan
    save_checkpoint(loaded, tmp_path / "nan.safetensors")
    (line,) = [line for line in r2flow("info", tmp_path / "nan.safetensors")[1].splitlines() if "not finite" in line]
    assert line.endswith(name)
    assert "not finite" not in r2flow("info", saved[0])[1]


def test_a_comparison_without_a_run_leaves_no_folder(r2flow, tmp_path: Path):
    assert r2flow("compare", tmp_path / "nowhere", "--out", tmp_path / "o")[0] == 2
    assert not (tmp_path / "o").exists()


def test_a_config_file_that_contains_itself_is_one_line(tmp_path: Path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "loop.yaml").write_text("stage: &stage\n  time: *stage\n")
    command = [*R2FLOW, "train", "--config-dir", str(tmp_path), "experiment=loop"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    "message",
    [
        "[../third_party/gloo/gloo/transport/tcp/pair.cc:534] Connection closed by peer [127.0.0.1]:42619",
        "NCCL error: remote process exited or there was a network error",
    ],
)
def test_a_lost_device_is_one_line(monkeypatch, tmp_path: Path, message: str):
    """As torch.distributed says it in the processes that are left."""

    def fit(*_, **__):
        raise RuntimeError(message)

    trainer = SimpleNamespace(world_size=2, max_steps=4, is_global_zero=False, fit=fit)
    run = SimpleNamespace(trainer=trainer, folder=tmp_path, config={}, data=None, stage=torch.nn.Linear(1, 1))
    monkeypatch.setattr(r2flow.training, "open_run", lambda *_: None)
    with pytest.raises(InputError, match="device"):
        r2flow.training._fit_in_folder(run)
    trainer.world_size = 1
    with pytest.raises(RuntimeError, match="peer|NCCL"):
        r2flow.training._fit_in_folder(run)
