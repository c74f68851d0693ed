"""Modules from outside: by name, by path, by entry point; never because a file names them."""

import importlib
import importlib.metadata
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from r2flow.backbones import BACKBONES
from r2flow.base import plugins
from r2flow.base.errors import InputError
from r2flow.base.plugins import load_plugins, made_with, take_plugins
from r2flow.base.registry import Registry
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.saving import save_checkpoint
from r2flow.reports.runs import read_runs
from r2flow.runs.composing import REGISTRIES, choices, compose
from r2flow.runs.folder import open_run
from r2flow.stages import STAGES
from r2flow.training import build
from tests.extension.conftest import FAMILIES, GAN, TINY, loaded
from tests.training.conftest import in_process

EXAMPLE = Path(__file__).parents[2] / "examples" / "street"


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    """What a test loads and adds is forgotten again; other tests compose every choice."""
    with loaded():
        yield


def test_a_plugin_stands_anywhere_on_the_command_line():
    assert take_plugins(["sample", "--num", "1"]) == (["sample", "--num", "1"], [])
    assert take_plugins(["--plugin", "a.b", "sample", "x"]) == (["sample", "x"], ["a.b"])
    assert take_plugins(["sample", "x", "--plugin=a.b", "--plugin", "./c.py"]) == (
        ["sample", "x"],
        ["a.b", "./c.py"],
    )


def test_a_forgotten_backbone_is_named_by_compare_and_by_a_file(tmp_path: Path):
    deep = tmp_path / "deep.py"
    deep.write_text(
        "from r2flow.backbones import BACKBONES\nBACKBONES.add('deep', BACKBONES['local'])\n"
    )
    plugins._loaded.clear()  # of other tests of this process
    load_plugins([str(deep)])
    run = build(compose(["backbone=deep", f"run_dir={tmp_path}/run"]))
    open_run(run.folder, run.config.plain())
    save_checkpoint(
        Checkpoint(run.stage.generator, run.config.plain()), tmp_path / "deep.safetensors"
    )
    plugins._loaded.clear()
    del BACKBONES._entries["deep"]
    with pytest.raises(InputError, match=f"no backbone named 'deep'; .*: give --plugin {deep}"):
        read_runs([run.folder])
    with pytest.raises(InputError, match="no backbone named 'deep'; .*: give --plugin deep.py"):
        load_checkpoint(tmp_path / "deep.safetensors")


def test_a_stage_that_takes_its_own_steps_clips_for_itself():
    with loaded(GAN):
        config = compose(
            [*TINY, *GAN.choices, "trainer.gradient_clip_val=0.5", "callbacks.checkpoint=null"]
        )
        run = build(config)
        assert run.stage.gradient_clip_val == 0.5
        # Lightning's write none
        assert (run.trainer.gradient_clip_val, run.trainer.checkpoint_callbacks) == (None, [])
        config["trainer"]["accumulate_grad_batches"] = 2
        with pytest.raises(InputError, match="stage=toy_gan takes its own optimiser steps"):
            build(config)


def test_a_plugin_is_not_imported_because_a_file_names_it(tmp_path: Path):
    theirs = FAMILIES / "toy_gan.py"
    made = made_with([str(theirs)], "it")
    with (
        pytest.raises(InputError, match=f"no stage named 'toy_gan'; .* give --plugin {theirs}"),
        made,
    ):
        STAGES["toy_gan"]
    folder = tmp_path / "conf" / "experiment"
    folder.mkdir(parents=True)
    of_a_sweep = f"hydra:\n  sweeper:\n    params:\n      plugins: '[{theirs}]'"
    for text, flags in ((f"plugins: [{theirs}]", ()), (of_a_sweep, ("-m",))):
        (folder / "theirs.yaml").write_text(f"# @package _global_\n{text}\n")
        done = in_process(
            tmp_path, ["--config-dir", str(folder.parent), *flags, "experiment=theirs"], check=False
        )
        assert f"never in a file: give --plugin {theirs}" in done.refusal
    assert "toy_gan" not in STAGES


def test_one_file_is_imported_once_however_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "counted.py").write_text("open('count', 'a').write('x')")
    monkeypatch.chdir(tmp_path)
    load_plugins(["counted.py", "./counted.py", str(tmp_path / "counted.py")])
    load_plugins([str(tmp_path / "counted.py"), "counted"])
    assert Path("count").read_text() == "x"
    (tmp_path / "named.py").write_text("open('named', 'a').write('x')")
    load_plugins(["named", "named.py"])
    assert Path("named").read_text() == "x"


def test_a_plugin_imports_what_lies_beside_it(tmp_path: Path):
    (tmp_path / "lies_beside.py").touch()
    (tmp_path / "imports.py").write_text("import lies_beside")
    load_plugins([str(tmp_path / "imports.py")])


def test_an_installed_plugin_is_looked_for_where_a_name_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "somebodys.py").write_text(
        "from tests.training.test_plugins import TABLE\nTABLE.add('mine', 1)\n"
    )
    found = importlib.metadata.EntryPoint("somebodys", "somebodys", plugins.GROUP)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [found])
    monkeypatch.setattr(plugins, "_loaded", {})
    monkeypatch.setattr(Registry, "on_missing", [plugins.load_installed])
    monkeypatch.syspath_prepend(tmp_path)
    assert TABLE["mine"] == 1


TABLE: Registry[int] = Registry("thing")


@pytest.mark.parametrize("group", list(REGISTRIES))
def test_what_is_in_a_registry_without_a_yaml_file_becomes_a_choice(
    group: str, monkeypatch: pytest.MonkeyPatch
):
    module, table, _ = REGISTRIES[group]
    registry: Registry[Any] = getattr(importlib.import_module(module), table)
    original = next(iter(registry.items()))[1]
    monkeypatch.setattr(registry, "_entries", {**registry._entries, "somebodys": original})
    assert compose([f"{group}=somebodys"])[group]["name"] == "somebodys"
    assert set(choices(group)) >= {"somebodys"}


# street is a chain
LINKS = sorted({file.stem for file in (EXAMPLE / "experiment").glob("*.yaml")} - {"street"})


@pytest.mark.parametrize("name", LINKS)
def test_an_example_lacks_its_files_alone(tmp_path: Path, name: str):
    of_links = () if name == "street_1rf" else ("stage.parent=street",)
    root = ("data.root=runs/street/scenes",) if name == "finetune_map" else ()
    command = [
        "--plugin",
        str(EXAMPLE / "street_stage.py"),
        "--config-dir",
        str(EXAMPLE),
        f"experiment={name}",
    ]
    assert (
        "runs/street/scenes"
        in in_process(tmp_path, [*command, *of_links, *root], check=False).refusal
    )
