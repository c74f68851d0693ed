"""Several hundred wrong commands over every verb and config group: one line, exit code 2, nothing
written.

A line of the lists is a command and, after a ` # `, what its answer must say. Without that, it must
name one of the command's own options, keys or values.
"""

import contextlib
import inspect
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import yaml
from typer.models import OptionInfo

import r2flow.runs.chain
import r2flow.training
from r2flow import cli
from r2flow.cli import verbs  # noqa: F401  which enters them
from r2flow.cli.app import app
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.saving import save_checkpoint
from tests.conftest import CONFIG, ground, write_checkpoint

VERBS = """
nope # No such command 'nope'
sampel -c run -o out # Did you mean 'sample'?
densify x.pcd -o out # Did you mean 'r2flow complete SCANS -c densify --out FOLDER'?
street # Did you mean 'r2flow sample -c street --out FOLDER'?
sample empty -o out
sample nowhere -o file.txt # file.txt is not a folder that can be written to
complete nowhere -o file.txt # file.txt is not a folder that can be written to
info ~nouser/run # Write the path in full
info --add rangenet53 file.txt
sample run -o out --sampler dopri5 --steps 50 # steps
sample run -o out --seed 18446744073709551616 # 18446744073709551615
sample run -o out --format npy, # --format 'npy,' cannot
sample run -o out --grid power:10 --steps 64 # 64 steps on power:10
sample '' -o out # an argument is empty
sample run -o out --steps 10000000 # 1,000,000
export flow.safetensors --to safetensors --out ./flow.safetensors # replaced
export run --from vlp16 # --from, --sensor and --size are for models that complete
export densify # name the sensor of the scans: --from vlp16
export densify --from vlp16 --steps 2 # exported whole, as one jump
export run --to onx # 'onx' is not one of 'onnx', 'pt2', 'safetensors'
export run --to pt2 --out a.onnx # --to pt2 writes a .pt2, found --out a.onnx
export run --to pt2 --out empty/a.pt2 # --to pt2 writes a .pt2, found --out empty/a.pt2
report backbones --size ²x²
report backbones --size 99999999x99999999 # at most 16,777,216 pixels
complete scans/000000.bin -c run -o out --to os1_64
view scans -o file.txt/a.html
simulate -o out --size 1x1 # found 1
simulate -o out --format npy --labels
simulate -o scans --num 1 --size 8x64 # holds scans
interpolate run scans/000000.bin bad.bin -o out
interpolate run scans scans -o out # scan
show file.txt -o out
show scans -o out --projection unfolding --sensor hdl64e
show run -o out # a run without samples
show street -o out # sample it first: r2flow sample street --out scans
show nope:scans -o out
sensor image.npy
sensor scans -o out # a .yaml file
sensor scans -o file.txt/out.yaml
prepare empty -o out
prepare simulated:3 -o out
prepare scans/000000.bin -o out
prepare scans -o out --drives 77
pairs run --num 1 --seed 99999999999999999999
evaluate scans # nothing to compare with
show scans -o scans --format npy # is the folder of the scans
evaluate simulated:3 scans --split test # simulated:3 has no split: leave 'test' out
evaluate scans scans --json file.txt/a.json
evaluate simulated:² scans # as simulated:0; found 'simulated:²'
report solvers -o out --problems none # nothing to measure
report paper run -o out --results nowhere
"""

# What each verb's wrong values are tried on, and words that no option takes.
BASES = {
    "sample": "sample run -o out", "pairs": "pairs run --num 1", "simulate": "simulate -o out",
    "complete": "complete scans/000000.bin -c run -o out", "view": "view scans run -o out.html",
    "show": "show scans -o out",
    "interpolate": "interpolate run scans/000000.bin scans/000001.bin -o out", "sensor": "sensor scans",
    "prepare": "prepare scans -o out", "evaluate": "evaluate scans run --metrics jsd", "compare": "compare run",
    "curvature": "report curvature run -o out", "solvers": "report solvers -o out",
    "backbones": "report backbones", "paper": "report paper run --results nowhere -o out",
}  # fmt: skip
WORDS = (
    "device",
    "sensor",
    "sampler",
    "format",
    "projection",
    "convention",
    "precision",
    "metrics",
)


def wrong_places() -> Iterator[str]:
    """Of each verb: with nothing, with what is not there, and a file where its folder is to be."""
    for verb, base in BASES.items():
        if verb != "backbones":
            yield f"{'report ' if base.startswith('report') else ''}{verb} # Missing"
            missing, changed = re.subn(r"\b(run|scans)\b\S*", "nowhere", base, count=1)
            yield from [missing] * changed
        if verb not in ("backbones", "view", "sensor"):
            yield f"{base.removesuffix(' -o out')} -o file.txt"


def wrong_values() -> Iterator[str]:
    """Values out of the range of each option's annotation, one command each."""
    registered = [
        *app.registered_commands,
        *app.registered_groups[0].typer_instance.registered_commands,
    ]
    for verb, callback in ((one.callback.__name__, one.callback) for one in registered):
        for name, parameter in inspect.signature(callback).parameters.items():
            annotation = parameter.annotation
            options = [
                one
                for one in getattr(annotation, "__metadata__", ())
                if isinstance(one, OptionInfo)
            ]
            if verb not in BASES or not options:
                continue
            kinds = {annotation.__origin__, *get_args(annotation.__origin__)}
            long = [one for one in options[0].param_decls if one.startswith("--")] or [
                f"--{name.replace('_', '-')}"
            ]
            values = ["nope"] if name in WORDS else []
            values += ["64"] if name == "size" else []
            values += ["a", "1.5"] if int in kinds else []
            values += ["a", "nan"] if float in kinds else []
            values += [] if options[0].min is None else [str(options[0].min - 1)]
            values += [] if options[0].max is None else [str(options[0].max + 1)]
            yield from (f"{BASES[verb]} {long[0]} {value}" for value in values)


TRAIN = """
name=x +samples.steps=3
name=x backbone.base_channels=7
name=x backbone.name=null
name=x data=folder data.root=scans data.reading.projection=flat
name=x data=folder data.root=scans data.validation.data=3
name=x stage=reflow data=pairs stage.parent=run data.pairs.sampler.name=eulr
--plugin
name=x 'chain={a/b: {seed: 3}}'
name=x 'chain={1: {seed: 3}}' # ('1', not 1)
name=x experiment=demo chain.rf1=null
name=a/../../b
name=x 'data={' # data={ cannot be read
name=x seed=${seed} # interpolation
name=x --config-dir nowhere
-m seed=1,2 hydra/job_logging=nope # known: default, disabled
-m seed=1,2 --cfg job # one of
name=x hydra.run.dir=file.txt
name=x data@foo=kitti_raw
name=x scans=3 # no key 'scans'
name=x +parent=3
"""

USUAL = {
    "",
    "-",
    "c",
    "o",
    "x",
    "a",
    "1",
    "0",
    "3",
    "name",
    "run",
    "out",
    "scans",
    "train",
    "data",
    "report",
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("place")
    sensor = SENSORS["hdl64e"].resized(16, 128)
    for number in range(3):
        points = image_to_points(ground(sensor, 20 + number), sensor.rays())
        write_points(place / "scans" / f"{number:06d}.bin", *points)
    write_checkpoint(place / "run" / "checkpoints" / "step-00000007.ckpt", CONFIG)
    (place / "run" / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    save_checkpoint(load_checkpoint(place / "run"), place / "flow.safetensors")
    (place / "empty" / "a.pt2").mkdir(parents=True)
    np.save(
        place / "image.npy",
        np.stack([np.full((8, 64), 9.0), np.full((8, 64), 0.5)]).astype(np.float32),
    )
    (place / "bad.bin").write_bytes(b"\0" * 30)
    (place / "bad.yaml").write_text("name: mine\nelevations: [3]\n")
    (place / "file.txt").write_text("in the way")
    return place


def listing(folder: Path) -> dict[Path, tuple[int, int]]:
    found = {path: path.stat() for path in sorted(folder.rglob("*"))}
    return {
        path: (stat.st_size, 0 if path.is_dir() else stat.st_mtime_ns)
        for path, stat in found.items()
    }


@pytest.fixture
def refused(place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    def ready(run: r2flow.training.Run) -> None:
        if run.config.data.name != "simulated":
            run.data.read()
        raise AssertionError("it would train")

    monkeypatch.setattr(r2flow.training, "fit", ready)
    monkeypatch.setattr(r2flow.runs.chain, "fit", ready)

    def check(line: str) -> None:
        command, _, words = line.partition(" # ")
        arguments = shlex.split(command)
        monkeypatch.setattr(sys, "argv", ["r2flow", *arguments])
        before = listing(place)
        with contextlib.chdir(place), pytest.raises(SystemExit) as end:
            cli.main()
        said = capfd.readouterr().err
        assert end.value.code == 2, said
        (answer,) = (line for line in said.splitlines() if not line.startswith("WARNING"))
        assert answer.startswith("error: ")
        named = {
            word
            for argument in arguments[1:]
            for word in re.split(r"[^\w²-]+", argument.strip("-"))
        }
        wanted = (
            {words}
            if words
            else (named - USUAL) | {one for one in arguments if one.startswith("--")}
        )
        assert any(word in answer for word in wanted), answer
        assert listing(place) == before

    return check


@pytest.mark.parametrize("line", [*VERBS.strip().splitlines(), *wrong_places(), *wrong_values()])
def test_a_wrong_verb_or_option_is_refused(refused, line: str):
    refused(line)


@pytest.mark.slow
@pytest.mark.parametrize("line", TRAIN.strip().splitlines())
def test_a_wrong_config_is_refused(refused, line: str):
    refused(f"train {line}")
