"""Run folders of version 0.1.0 go on (`tests/fixtures/0.1.0`), and end as that version would have ended them."""

import re
import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from torch import Tensor

from r2flow.model.checkpoint import checkpoints_of, read_checkpoint
from r2flow.training import Result, build, compose, fit
from tests.conftest import ROOT
from tests.training.conftest import run_links

OLD = ROOT / "tests" / "fixtures" / "0.1.0"

COMMON = [
    "data.batch_size=4",
    "stage.warmup_images=16",
    "trainer.accelerator=cpu",
    "trainer.max_steps=8",
    "trainer.val_check_interval=4",
    "trainer.log_every_n_steps=1",
    "callbacks.ema.every=2",
    "callbacks.checkpoint.every=4",
    "callbacks.pictures=null",
    "callbacks.curvature=null",
    "samples.num=0",
    "loggers=[csv]",
    "data.validation.share=0.25",
]
SCANS = [
    "sensor.rows=16",
    "sensor.columns=64",
    "backbone.base_channels=8",
    "backbone.depths=[1,1]",
    "backbone.num_heads=[1,2]",
    "backbone.time_channels=8",
    "backbone.patch=[2,4]",
    "backbone.dropout=0.1",
    "data.scenes=16",
]
PAIRS = ["data.pairs.num=8", "data.pairs.method=midpoint", "data.pairs.steps=4", "data.pairs.batch_size=4"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of what 0.1.0 left, where it was left: in runs/chain."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    monkeypatch.chdir(tmp_path)
    yield Path(shutil.copytree(OLD / "chain", tmp_path / "runs" / "chain"))
    torch.set_num_threads(threads)


def as_of_this_simulator(run: Path) -> None:
    """Tell a run the present name of its scans: another revision's are refused, but these 16 are still the same."""
    data = build(compose([*SCANS, *COMMON])).data
    data.setup()
    config = run / "config.yaml"
    before = config.read_text()
    config.write_text(re.sub("^scans: .*$", f"scans: {data.fingerprint()}", before, flags=re.MULTILINE))
    assert config.read_text() != before


def go_on(*overrides: str) -> Result:
    return fit(build(compose(overrides), overrides))


def weights(checkpoint: Path) -> dict[str, Tensor]:
    """Raw and averaged ones, by the backbone's own names."""
    content = read_checkpoint(checkpoint)
    kinds = {"raw": content["current_model_state"], "averaged": content["state_dict"]}
    return {
        f"{kind}/{name.removeprefix('generator.backbone.')}": value
        for kind, state in kinds.items()
        for name, value in state.items()
    }


def assert_as_before(found: Mapping[str, Tensor], before: Mapping[str, Tensor]) -> None:
    """To rounding: CPUs of one capability and one torch have differed by 1e-9 after four steps of 2e-3 each."""
    assert found.keys() == before.keys()
    for name, value in before.items():
        torch.testing.assert_close(found[name], value, rtol=0, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}")


def test_a_stopped_1_rf_goes_on(folder: Path):
    run = folder.rename(folder.parent / "moved") / "rf1"
    shutil.rmtree(run / "pairs")
    as_of_this_simulator(run)
    ended = checkpoints_of(run)[0].rename(run.parent / "ended.ckpt")
    result = go_on(*SCANS, *COMMON, f"run_dir={run}")
    assert (result.step, result.finished) == (8, True)
    assert result.checkpoint is not None
    assert_as_before(weights(result.checkpoint), weights(ended))


def test_a_half_finished_2_rf_goes_on_with_its_parent_and_pairs(folder: Path):
    pairs = {path: path.read_bytes() for path in (folder / "rf1" / "pairs").iterdir()}
    result = go_on("experiment=reflow", *COMMON, *PAIRS, "stage.init=runs/chain/rf1", "run_dir=runs/chain/rf2")
    assert result.checkpoint is not None
    with safe_open(OLD / "rf2-step-8.safetensors", "pt") as file:
        before = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    assert_as_before(weights(result.checkpoint), before)
    assert {path: path.read_bytes() for path in (folder / "rf1" / "pairs").iterdir()} == pairs


def test_a_half_finished_chain_goes_on_inside_its_second_link(folder: Path):
    as_of_this_simulator(folder / "rf1")
    before = checkpoints_of(folder / "rf1")[0].stat().st_mtime_ns
    done = run_links(folder.parents[1], [
        "experiment=demo", "name=chain", *SCANS, *COMMON,
        *(f"chain.{link}.trainer.max_steps=8" for link in ("rf1", "rf2", "td2")),
        "chain.rf2.data.pairs.num=8", "chain.td2.data.pairs.num=8", "data.pairs.batch_size=4",
        "chain.rf2.data.pairs.steps=4", "chain.td2.data.pairs.steps=2",
    ])  # fmt: skip
    assert done.stdout.count("going on from") == 1
    assert "step-00000004.ckpt" in done.stdout[done.stdout.index("going on from") :].splitlines()[0]
    assert checkpoints_of(folder / "rf1")[0].stat().st_mtime_ns == before
    with safe_open(OLD / "rf2-step-8.safetensors", "pt") as file:
        ended = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    assert_as_before(weights(checkpoints_of(folder / "rf2")[0]), ended)
    assert (folder / "report" / "chain.md").is_file()
