"""Values of the wrong kind or out of their range, key by key: one line, exit code 2, nothing
written.
"""

import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from r2flow.callbacks.checkpoints import AtomicCheckpointIO

from r2flow.base.config import Free
from r2flow.base.errors import InputError, one_line
from r2flow.base.files import write_file
from r2flow.data.datamodule import ScanDataModule
from r2flow.generators import build_generator
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS, build_sensor, write_sensor
from r2flow.model.config import RunConfig, TrainerOptions
from r2flow.runs import launch
from r2flow.runs.folder import CONFIG, RESUMED, open_run, read_config
from r2flow.training import build, check, compose
from tests.conftest import refused
from tests.training.conftest import Run, in_process

REFUSED = {
    "stage.learning_rate=nan": "learning_rate: input should be a finite number, found nan",
    "stage.betas=[0.9]": "needs the option 'betas.1'",
    "stage.parent=3": "no checkpoint at 3",
    "stage=null": "Config group override must be a string or a list",
    "~backbone": "needs the option 'backbone'",
    "stage.time={name: logit_normal, std: 0}": "std: input should be greater than 0, found 0",
    "callbacks.ema={evry: 3}": "Could not override 'callbacks.ema'",
    "+callbacks.emaa={}": "Did you mean 'ema'?",
    "callbacks.ema.decay=2": "decay: input should be less than 1, found 2",
    "sampler={name: dopri5} & callbacks.pictures.steps=3": "callbacks.pictures: sampler 'dopri5': no option 'steps'",
    "callbacks.ema=3": "callbacks.ema: input should be a valid dictionary, found 3",
    "sampler=3": "sampler: input should be a valid dictionary, found 3",
    "sampler.name=": "no sampler named ''; known: adams3, ",
    "samples=null": "samples: input should be a dictionary",
    "sampler.grid=[a,b]": "grid: input should be a valid string, found ['a', 'b']",
    "backbone.base_channels=0": "base_channels: input should be greater than or equal to 1, found 0",
    "encoding.levels=1.5": "levels: must be whole and above 0, found 1.5",
    "backbone.window=[2,9]": "window.0: must be odd, found 2",
    "data.scans={name: simulated}": "data.scans needs data=pairs, found data=simulated",
    "data.reading.projection=unfolding": "leave data.reading out",
    "trainer.max_steps=abc": "trainer: max_steps: input should be a valid integer",
    "trainer.max_steps=null": "trainer: max_steps: input should be a valid integer, found None",
    "trainer.max_steps=0": "trainer: max_steps: must be -1 or above 0, found 0",
    "trainer.max_steps=nan": "trainer: max_steps: input should be a finite number",
    "trainer.accumulate_grad_batches=0": "trainer: accumulate_grad_batches: input should be greater",
    "trainer.gradient_clip_val=nan": "trainer: gradient_clip_val: input should be a finite number",
    "trainer.precision=16-mixed": "16-mixed needs a GPU: give bf16-mixed or 32-true",
    "seed=true": "seed: must be a number, found True",
    "chain=3": "chain: input should be a valid dictionary, found 3",
    "trainer.val_check_interval=0": "val_check_interval must be above 0",
    "stage.time={name: u_shaped, a: 800}": "a: must be above 0 and at most 80, found 800",
    "sampler.name=mmps": "completes scans: give it to r2flow complete by --sampler",
    "+callbacks.half_life_ema={half_life: 4, rampup: 1}": "one average of its weights, found callbacks.ema and",
    "trainer.accelerator=tpu": "trainer: ",
    "seed=99999999999999999999": "seed: input should be less than 9223372036854775808",
    "loggers=3": "loggers: input should be a list, found 3",
    "data=mixed & data.parts=[1] & stage.parent=street": "parts.0: input should be a valid dictionary, found 1",
    "+foo=3": "no option 'foo'",
    "~seed": "needs the option 'seed'",
    "run_dir=": "run_dir: must be a folder, found ''",
    "name=": "name: must be a folder in runs, found ''",
    "seed=${foo}": "'foo' not found",
    "=3": "Config group override must be a string or a list",
    "--foo": "unrecognized arguments: --foo; see --help",
    "seed=1,2": "Ambiguous value for argument 'seed=1,2' | use key=[value1,value2] | --multirun",
    "data=folder & data.root=. & data.scenes=5": "no simulated scenes: leave data.scenes out",
    "data=mixed & data.parts=[{name: simulated}] & data.split=train": "data.split does nothing for mixed scans: leave it out",
    "data.pairs.num=5": "data=simulated has no pairs (data=pairs has): leave data.pairs out",
    "stage=reflow & data=pairs & stage.parent=street & data.drives=[1]": "data.drives does nothing for pairs scans: leave it out",
    "stage=reflow & data=pairs & stage.parent=street & data.reading={convention: lidm}": "data.reading is that of the flow",
    "preview=street": "a chain of runs",
    "trainer.limit_test_batches=3": "Could not override 'trainer.limit_test_batches'",
    "data.workers=1000000000": "workers: input should be less than or equal to 1000, found 1000000000",
    "+stage.batch_size=9": "stage 'rectify': no option 'batch_size'",
    "bakcbone.base_channels=8": "Could not override 'bakcbone.base_channels'",
    "backbone=hditt": "Could not find 'backbone/hditt' | hdit_tiny",
    "expriment=r2dm": "Could not override 'expriment'",
    "hydra/sweeper=optuna": "Could not find 'hydra/sweeper/optuna' | basic",
    "hydra/launcher=submitit_of_tomorrow": "Could not find 'hydra/launcher/submitit_of_tomorrow' | slurm",
    "sensor=mine": "Could not find 'sensor/mine' | vlp16",
    "+backbone.widht=8": "no option 'widht'",
    "sensor.columns=100": "width 100 | multiple of 16, such as 112",
    "data=folder & data.root=/nowhere/at/all": "/nowhere/at/all is not a folder | data.root=FOLDER",
    "data.batch_size=3 & trainer.accumulate_grad_batches=2": "batch_size=3 | multiple of 2",
    "trainer.strategy=ddp & trainer.devices=2 & trainer.val_check_interval=00:00:00:09": "another step on each device",
    "encoding.format=log": "no range format named 'log' | Did you mean 'logscale'?",
    "sensor.rays=foo": "'centre' or 'reference' | 'foo'",
    "stage.time.name=discrete": "needs the option 'k'",
    "+data.validation.data={name: folder, root: x, splt: test}": "no option 'splt' | Did you mean 'split'?",
    "data.augment.roll=true": "data.augment.roll | backbone.position=learnable | backbone.position=none",
    "data.validation.data={name: mixed}": "needs the name of a data set",
}


# Keys of the Trainer whose values are text, among others; in which zero means something; in which
# -1 does; of yes and no.
TEXT = {"accelerator", "strategy", "devices", "precision", "max_time", "val_check_interval", "profiler",
        "default_root_dir"}  # fmt: skip
ZERO = {"fast_dev_run", "limit_val_batches", "overfit_batches", "val_check_interval", "num_sanity_val_steps",
        "log_every_n_steps", "gradient_clip_val", "reload_dataloaders_every_n_epochs", "precision"}  # fmt: skip
LESS = {"max_epochs", "max_steps", "num_sanity_val_steps", "devices", "precision"}
SWITCHES = {
    one.name for one in fields(TrainerOptions) if one.type is bool or one.type == Free[bool]
}
SWITCHES |= {"deterministic", "benchmark"}


def refusal(action: Callable[[], object]) -> str:
    """What an error says, in one line; empty if there is none."""
    try:
        action()
    except InputError as error:
        return one_line(str(error))
    return ""


@pytest.mark.parametrize("key", [one.name for one in fields(TrainerOptions)])
def test_every_key_of_the_trainer_has_a_type_and_bounds(key: str):
    config = compose(["trainer.accelerator=cpu"])

    def taken(value: object) -> bool:
        said = refusal(
            lambda: RunConfig.of({**config, "trainer": {**config["trainer"], key: value}})
        )
        assert said == "" or said.startswith(f"trainer: {key}")
        return said == ""

    assert taken(config["trainer"][key])
    for wrong in (math.nan, math.inf, -math.inf, [["a"]], {"a": {"b": 1}}):
        assert not taken(wrong), wrong
    for huge in (10**30, 1e30):  # no gradient is as long
        assert taken(huge) == (key == "gradient_clip_val"), huge
    assert taken("abc") == (key in TEXT)
    assert taken(0) == (key in ZERO | SWITCHES)
    assert taken(-1) == (key in LESS)
    assert taken(-7) == (key == "precision")  # Lightning refuses it
    assert taken(True) == (key in SWITCHES | {"fast_dev_run"})


@pytest.mark.parametrize(
    ("key", "value"),
    [*((key, 0) for key in sorted(ZERO)), *((key, "abc") for key in sorted(TEXT))],
)
def test_what_only_lightning_knows_is_refused_in_one_line(key: str, value: object):
    config = compose(["trainer.accelerator=cpu"])
    said = refusal(lambda: build({**config, "trainer": {**config["trainer"], key: value}}))
    assert said == "" or "trainer" in said
    if value == "abc":
        assert (said == "") == (key == "default_root_dir")


@pytest.mark.parametrize(("arguments", "words"), REFUSED.items(), ids=REFUSED)
def test_a_wrong_value_is_refused(tmp_path: Path, arguments: str, words: str):
    line = in_process(
        tmp_path,
        ["name=bad", "trainer.accelerator=cpu", "trainer.max_steps=1", *arguments.split(" & ")],
        check=False,
    ).refusal
    assert line.startswith("error: ")
    assert all(word in line for word in words.split(" | ")), line
    assert list(tmp_path.iterdir()) == []


def test_python_refuses_a_wrong_key_and_a_chain():
    for words, wrong in (
        (
            "Could not override 'stage.step'",
            lambda: compose(["stage=distill", "stage.step=3"]),
        ),
        (
            "a chain of runs: train it by `r2flow train`",
            lambda: build(compose(["experiment=demo"])),
        ),
        ("reflectance: input should be a valid boolean", lambda: build_generator(compose())),
    ):
        with refused(words):
            wrong()


def test_a_folder_of_configs_may_have_any_name(tmp_path: Path):
    write_file(tmp_path / "é, [1]" / "experiment" / "mine.yaml", "# @package _global_\nseed: 9")
    assert compose(["experiment=mine"], [tmp_path / "é, [1]"])["seed"] == 9
    damaged = (
        (b"a: \xfc", "'utf-8' codec can't decode byte 0xfc"),
        ("seed: 9\nseed: 8", 'mine.yaml", line 2'),
    )
    number = ("# @package _global_\n1: 2", "no option '1'")
    for text, said in (
        *damaged,
        number,
        ("seed: 9", "experiment: input should be a valid string, found"),
        ("a: ${", "'${'"),
    ):
        write_file(tmp_path / "é, [1]" / "experiment" / "mine.yaml", text)
        assert (
            said
            in in_process(
                tmp_path, ["--config-dir", "é, [1]", "experiment=mine"], check=False
            ).refusal
        )
    write_file(tmp_path / "é, [1]" / "data" / "mine.yaml", "root: scans")
    refusal = in_process(tmp_path, ["--config-dir", "é, [1]", "data=mine"], check=False).refusal
    assert "data: must be a group with a name, found {'root': 'scans'}" in refusal


def test_a_run_learns_the_levels_of_its_scans_unless_told(tmp_path: Path):
    asked = ["data.scenes=2", "backbone=hdit_tiny", f"run_dir={tmp_path}"]
    assert build(compose(asked), asked).config.encoding["levels"] == 100
    # none drawn
    asked += [
        "encoding.levels=50.0",
        "sampler.name=dopri5",
        "+callbacks.pictures={every: 0, steps: 3}",
    ]
    run = build(compose(asked), asked)
    assert run.config.encoding["levels"] == run.stage.generator.space.encoding.levels == 50


def test_scans_in_files_take_the_place_of_an_experiments_simulated_scenes(
    scans: Path, tmp_path: Path
):
    asked = [
        "experiment=densify",
        "data=folder",
        f"data.root={scans}",
        f"run_dir={tmp_path / 'run'}",
    ]
    assert build(compose([*asked, "data.scenes=99"]), asked).data.options.name == "folder"
    asked[1:3] = []
    assert 99 not in {
        part.options.scenes
        for part in build(compose([*asked, "data.scenes=99"]), asked).data.plan.sets
    }


def test_a_sensors_file_gives_way_to_keys_before_and_after_it(tmp_path: Path):
    write_sensor(replace(SENSORS["vlp16"], name="mine"), tmp_path / "my sensor.YAML", "")
    sensor = compose(
        ["sensor.columns=256", f"sensor='{tmp_path}/my sensor.YAML'", "sensor.min_range=3"]
    )["sensor"]
    assert [sensor[key] for key in ("name", "rows", "columns", "min_range")] == [
        "mine",
        None,
        256,
        3,
    ]
    assert sensor["elevations"] == list(SENSORS["vlp16"].elevations)
    part = {"name": "simulated", "sensor": str(tmp_path / "my sensor.YAML")}
    (own,) = ScanDataModule("mixed", parts=[part]).plan.sensors
    assert own == replace(SENSORS["vlp16"], name="mine")
    # a built-in sensor by its name
    (tmp_path / "own.yaml").write_text("{name: hdl32e, rows: 16, rays: centre}")
    assert build_sensor(**compose([f"sensor={tmp_path}/own.yaml"])["sensor"]) == SENSORS[
        "hdl32e"
    ].resized(16)


def test_a_named_choice_has_options_of_its_own():
    assert compose(["stage.time={name: logit_normal, mean: 2}"])["stage"]["time"] == {
        "name": "logit_normal",
        "mean": 2,
    }
    # without a
    assert compose(["stage=reflow", "stage.time={name: uniform}"])["stage"]["time"] == {
        "name": "uniform"
    }


def test_a_generator_without_options_is_given_by_its_name():
    named = check(compose(["generator=rectified_flow"]))
    assert named.generator == {"name": "rectified_flow"} == check(compose([])).generator


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def f(:\n", "SyntaxError"),
        ("def f():\n    raise RuntimeError('a\\nb')\nf()", "RuntimeError: a b (line 2)"),
        ("import sys; sys.exit(0)", "SystemExit"),
        (
            "from r2flow.stages import STAGES, Rectify\nSTAGES.add('rectify', Rectify)",
            "named 'rectify' exists already",
        ),
    ],
)
def test_a_plugin_that_does_not_load(tmp_path: Path, text: str, words: str):
    (tmp_path / "plugin.py").write_text(text)
    line = in_process(tmp_path, ["--plugin", "plugin.py", "name=bad"], check=False).refusal
    assert line.startswith("error: the plug-in plugin.py cannot be imported: ")
    assert words in line
    assert not (tmp_path / "runs").exists()


def test_a_folder_is_no_plugin(tmp_path: Path):
    (tmp_path / "no_package").mkdir()
    assert (
        "without an __init__.py"
        in in_process(tmp_path, ["--plugin", "no_package"], check=False).refusal
    )


@pytest.mark.parametrize(
    "text", ["", "- 1", "x", "a: [", "a: \0", "data: 3", "trainer: [1]", "a: &a [*a]"]
)
def test_a_damaged_config_is_refused_in_one_line(tmp_path: Path, text: str):
    (tmp_path / CONFIG).write_text(text)
    with refused("config.yaml is damaged (", "); the checkpoints are usable"):
        read_config(tmp_path)


def test_checkpoints_without_their_config_are_not_resumed(tmp_path: Path):
    newest = tmp_path / "checkpoints" / "step-00000004.ckpt"
    AtomicCheckpointIO().save_checkpoint(dict.fromkeys(RESUMED), newest)
    with refused(f"without their config.yaml: give name=OTHER stage.parent={newest}"):
        open_run(tmp_path, {"seed": 1, "trainer": {"max_steps": 4}})
    assert not (tmp_path / CONFIG).exists()


def test_one_bad_scan_stops_the_run_or_is_left_out(train: Run, scans: Path, tmp_path: Path):
    folder = Path(shutil.copytree(scans, tmp_path / "copy"))
    (folder / "000004.bin").write_bytes(b"\0" * 33)
    inside = f"run_dir={folder}/000000.bin/run"  # refused before a scan is read
    for where, words in (
        ("name=strict", "data.reading.on_bad_scan=skip"),
        (inside, "0.bin is not a folder that can"),
    ):
        refusal = train(f"data.root={folder}", where, check=False).refusal
        assert words in refusal
        assert ("000004.bin" in refusal) == (where != inside)
    assert not (tmp_path / "runs" / "strict").exists()
    done = train(
        f"data.root={folder}",
        "name=lenient",
        "data.reading.on_bad_scan=skip",
        "trainer.max_steps=2",
    )
    assert "left out" in done.stdout + done.stderr
    assert (tmp_path / "runs" / "lenient" / "checkpoints").exists()


def test_a_misspelt_config_is_answered_without_loading_torch(tmp_path: Path):
    mistakes = ["bakcbone.base_channels=8", "backbone=hditt", "chain=[", "+experiment=reflo"]
    script = f"for one in {mistakes}: print(run(['train', one], []), 'torch' in sys.modules)"
    command = [sys.executable, "-c", f"import sys; from r2flow.cli.verbs import run\n{script}"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False
    )
    assert (done.stdout, len(done.stderr.splitlines())) == (4 * "2 False\n", 4), done.stderr


@pytest.mark.parametrize(("options", "value"), [([], 0.25), (["metric=bend"], 3.5), (["metric=x"], None)])  # fmt: skip
def test_a_job_of_a_sweep_returns_its_last_metric(tmp_path, monkeypatch, options, value):
    returned = []
    sweep_job = launch._sweep_job
    monkeypatch.setattr(launch, "_sweep_job", lambda *args: returned.append(sweep_job(*args)))

    def run_process(command: list[str]) -> int:
        run = Path(command[-1].partition("=")[2].strip("'"))
        logged = "step,val/loss,bend\n9,0.75,\n19,0.25,\n19,,3.5\n"
        write_file(run / "metrics" / "version_0" / "metrics.csv", logged)
        return 0

    monkeypatch.setattr(launch, "run_process", run_process)
    in_process(tmp_path, ["-m", "seed=1,2", *options])
    assert returned == [value, value]


@pytest.mark.parametrize("command", [["-m", "seed=1,2"], ["experiment=demo"]])
def test_intensities_beyond_their_scale_are_refused_once_before_any_work(
    tmp_path, monkeypatch, command
):
    points = np.random.default_rng(0).normal(0, 10, (500, 3)).astype(np.float32)
    bright = np.arange(500, dtype=np.float32) % 250 + 1
    write_points(tmp_path / "scans" / "a.bin", points, bright)
    monkeypatch.setattr(launch, "run_process", pytest.fail)
    monkeypatch.setattr(launch, "_draw_preview", pytest.fail)
    scans = ["data=folder", f"data.root={tmp_path / 'scans'}", "trainer.accelerator=cpu"]
    said = in_process(tmp_path, [*command, *scans], check=False).refusal
    assert "reflectance must lie in [0, 1], found up to 250" in said
    assert "data.reading.reflectance_scale=255" in said


def test_a_report_of_a_chain_that_was_interrupted_is_made_by_the_next_run(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr("r2flow.runs.folder.has_ended", lambda run: True)
    monkeypatch.setattr("r2flow.runs.chain.train_links", lambda links: 0)
    monkeypatch.setattr("r2flow.reports.chain.report_chain", lambda runs, out, device: made.append(out))  # fmt: skip
    write_file(tmp_path / "runs" / "demo" / "report" / "steps.png", "of a killed process")
    in_process(tmp_path, ["experiment=demo", "preview=null"])
    assert made == [Path("runs/demo/report")]
    write_file(tmp_path / "runs" / "demo" / "report" / "compare.md", "the last file")
    in_process(tmp_path, ["experiment=demo", "preview=null"])
    assert len(made) == 1
