"""The rules of config keys, and whether conf/ and the constructors say the same keys."""

import inspect
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from r2flow.callbacks import CALLBACKS

from r2flow.backbones import BACKBONES
from r2flow.base.config import as_override, flatten, key_of, rules_in
from r2flow.base.errors import InputError
from r2flow.base.registry import options_of, presets
from r2flow.data.augment import Augmentation
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.options import DataOptions, PairOptions, ReadingOptions, ValidationOptions
from r2flow.flow.maps import JumpTimes
from r2flow.flow.times import TIMES
from r2flow.model.config import RunConfig, is_free, links_of_key
from r2flow.model.lineage import Parent
from r2flow.model.parts import MODEL
from r2flow.runs.composing import CONF, choices, compose
from r2flow.stages import STAGES
from r2flow.stages.transfer import Tasks
from r2flow.systems.gan.augment import AdaptiveAugment
from r2flow.systems.gan.dcgan import Discriminator
from r2flow.systems.gan.stage import Warmup
from r2flow.systems.latent.stage import _PatchDiscriminator
from r2flow.training import check


@pytest.fixture(scope="module")
def config() -> dict[str, Any]:
    return compose()


def test_the_key_of_an_override():
    overrides = "data.root=x +data.augment.flip=true ~callbacks.ema sensor@_global_.sensor=vlp16 hydra/launcher=slurm"
    keys = ["data.root", "data.augment.flip", "callbacks.ema", "sensor", "hydra.launcher"]
    assert list(map(key_of, overrides.split())) == keys


def test_every_key_has_a_type(config):
    known = rules_in(RunConfig)
    for key, _ in flatten(config):
        of_a_class = key.split(".")[0] in ("stage", "backbone", "sensor", "encoding", "callbacks")
        groups = {"data.augment", "data.pairs.sampler", "sampler"}
        within = any(key.startswith(f"{group}.") for group in groups)
        assert key in known or of_a_class or within, key


def test_the_free_keys_are_those_that_do_not_affect_the_weights():
    free = ["data.root", "data.parts.0.root", "data.scans.root", "data.validation.data.root"]
    free += [
        "data.workers",
        "data.memory_gib",
        "data.pairs.of",
        "stage.parent.path",
        "sampler.steps",
    ]
    free += [
        "trainer.devices",
        "trainer.accumulate_grad_batches",
        "trainer.precision",
        "callbacks.pictures.num",
        "samples.num",
        "name",
    ]
    assert all(map(is_free, free))
    fixed = [
        "data.name",
        "data.batch_size",
        "data.parts.0.weight",
        "data.pairs.num",
        "data.scans.name",
    ]
    fixed += ["stage.learning_rate", "stage.parent.weights", "callbacks.ema.decay", "seed", "scans"]
    fixed += ["trainer.max_steps", "callbacks.of_a_plug_in.x"]
    assert not any(map(is_free, fixed))


@pytest.mark.parametrize(
    ("override", "links"),
    {
        "experiment=x": "none", "size=small": "none", "hydra.mode=x": "none", "name=x": "none", "chain.rf1.seed=2": "none",
        "data=folder": "scans", "data.root=x": "scans", "data.a_key_of_tomorrow=1": "scans", "sensor.rows=4": "scans",
        "backbone@_global_.backbone=hdit": "scans", "data.validation.data.root=x": "scans",
        "data.batch_size=2": "all", "data.validation.share=0.1": "all", "trainer.max_steps=2": "all", "+trainer.x=1": "all",
        "data.workers=1": "all", "data.pairs.num=2": "pairs", "data.scans.name=x": "pairs", "seed=1": "all",
    }.items(),
)  # fmt: skip
def test_links_of_a_chain_take_what_concerns_them(override: str, links: str):
    assert links_of_key(override) == links


Entry = tuple[str, Callable[..., Any], dict[str, Any], set[str]]


@pytest.fixture(scope="module")
def entries(config) -> list[Entry]:
    """(group, constructor, what the composed config says, what the run adds)."""
    found: list[Entry] = []
    for name in choices("stage"):
        stage = dict(compose([f"stage={name}"])["stage"])
        # it has optimisers of its own
        unused = {"muon", "warmup_images", "weight_decay"} if name == "gan" else set()
        added = {*MODEL, "sampler", "few", "seed"} | unused
        found.append((f"stage={name}", STAGES[stage.pop("name")], stage, added))
    for name in choices("backbone"):
        backbone = dict(compose([f"backbone={name}"])["backbone"])
        added = {"rays", "in_channels", "out_channels", "second_time"}
        found.append((f"backbone={name}", BACKBONES[backbone.pop("name")], backbone, added))
    for name, options in config["callbacks"].items():
        found.append((f"callbacks.{name}", CALLBACKS[name], options, set()))
    data = config["data"]
    found.append(("data", DataOptions, data, set()))
    found.append(("data.augment", Augmentation, data["augment"], set()))
    found.append(("data.pairs", PairOptions, data["pairs"], {"parent"}))
    # no run tests or predicts
    idle = {"limit_test_batches", "limit_predict_batches", "model_registry"}
    found.append(
        ("trainer", L.Trainer, config["trainer"], {"callbacks", "logger", "plugins"} | idle)
    )
    return found


def test_conf_says_every_option_of_a_constructor(entries: list[Entry]):
    for group, constructor, options, added in entries:
        assert set(options) - added == set(options_of(constructor)) - added, group


# Constructors of the groups within groups.
WITHIN = {
    "stage=flow_map.jumps": JumpTimes,
    "stage=transfer.tasks": Tasks,
    "stage=gan.discriminator": Discriminator,
    "stage=gan.warmup": Warmup,
    "stage=gan.augment": AdaptiveAugment,
    "stage=autoencoder.discriminator": _PatchDiscriminator,
    "data.augment": Augmentation,
    "data.pairs": PairOptions,
    "data.reading": ReadingOptions,
    "data.validation": ValidationOptions,
}


def differing(group: str, constructor: Callable[..., Any], options: dict[str, Any]) -> list[str]:
    """Keys whose default in conf/ is not the constructor's."""
    found: list[str] = []
    defaults = options_of(constructor)
    for key, value in options.items():
        if key == "name":
            continue
        default = defaults.get(key)
        default = list(default) if isinstance(default, tuple) else default
        within = WITHIN.get(f"{group}.{key}")
        if within is not None:
            found += differing(f"{group}.{key}", within, value)
        elif key == "time" and isinstance(default, str):
            known = {"name": default, **options_of(TIMES[default])}
            found += [f"{group}.time"] * ({**known, **value} != known)
        elif key == "sampler":  # null: the sampler's own default
            named = {k: v for k, v in value.items() if v is not None}
            found += [f"{group}.sampler"] * (named != constructor().sampler)
        # the width of `time_channels` follows `base_channels`, None
        elif key != "time_channels" and default != value:
            found.append(f"{group}.{key}")
    return found


def test_conf_and_constructors_have_the_same_defaults(entries: list[Entry]):
    for group, constructor, options, _ in entries:
        # a preset has options of its own, and the Trainer's are those of a run of r2flow
        whole = (
            not group.startswith("backbone=")
            or group.removeprefix("backbone=") in BACKBONES._entries
        )
        if whole and group != "trainer":
            assert differing(group, constructor, options) == [], group


def test_the_data_module_has_the_options_of_data():
    module = inspect.signature(ScanDataModule).parameters
    for name, default in options_of(DataOptions).items():
        nested = isinstance(default, ValidationOptions | PairOptions)
        assert module[name].default == (None if nested else default), name


def test_the_groups_of_conf_are_groups_of_the_default_config(config):
    folders = {path.parent.name for path in CONF.glob("*/*.yaml")} - {
        "hydra",
        "experiment",
        "size",
    }
    assert folders == {key for key in config if choices(key)}
    assert all(isinstance(config[group], dict) for group in folders)
    text = (CONF / "train.yaml").read_text()
    # in --help
    assert all(
        f"{group}: ${{choices:{group}}}\n" in text for group in {*folders, "experiment", "size"}
    )


def test_a_folder_of_a_sweep_is_quoted_once():
    assert as_override("stage.parent", "sweep/seed=1") == "\"stage.parent='sweep/seed=1'\""


@pytest.mark.parametrize(
    "path",
    [
        "runs/sweep/seed=1-5b990e",
        "~/it's",
        'a "b" c',
        "a\\b=c",
        "ü,1",
        "a{b}[c]",
        "${x}",
        "a b\\",
        "ü",
        "1_2",
        "null",
    ],
)
def test_an_override_that_is_printed_is_read_back(path: str):
    (text,) = shlex.split(as_override("stage.parent", path))
    value = OverridesParser.create().parse_override(text).value()
    assert (key_of(text), getattr(value, "text", value)) == ("stage.parent", path)


def test_a_date_and_an_accent_need_quotes():
    assert compose(["run_dir='2011_09_26'"])["run_dir"] == "2011_09_26"
    assert compose(["run_dir='é'"])["run_dir"] == "é"
    with pytest.raises(InputError, match="run_dir=é"):
        compose(["run_dir=é"])


@pytest.mark.parametrize("experiment", ["lidm_autoencoder", "lidargen", "dusty2"])
def test_an_experiment_of_chosen_drives_takes_other_scans(experiment: str):
    check(compose([f"experiment={experiment}", "data=simulated"]))


@pytest.mark.parametrize(("choice", "roots"), [((), ["my/scans", None]), (["data=folder"], [])])
def test_fine_tuning_mixes_simulated_scans_in_unless_told(choice, roots):
    data = compose(["experiment=finetune", "data.root=my/scans", *choice])["data"]
    assert data["root"] == "my/scans"
    assert [part.get("root") for part in data["parts"] or ()] == roots


@pytest.mark.parametrize("plus", ["", "+", "++"])
def test_a_generator_is_named_by_its_key(plus: str):
    assert compose([f"{plus}generator.name=diffusion"])["generator"] == {"name": "diffusion"}


@pytest.mark.parametrize("backbone", ["adm_unet_18m", "hdit_tiny"])
def test_a_chosen_backbone_is_whole_at_every_size(backbone: str):
    for size in ("full", "small"):
        composed = compose(
            ["experiment=r2dm", f"size={size}", "data.root=x", f"backbone={backbone}"]
        )
        assert composed["backbone"] == presets("backbone")[backbone]


@pytest.mark.parametrize("asked", ["backbone=hdit_small", "backbone.depths=[1]"])
def test_a_backbone_for_a_system_with_its_own_network_is_refused(asked: str):
    command = ["experiment=vanilla_gan", "size=small"]
    gan = check(compose(command), command).model_config()
    with pytest.raises(InputError, match=r"stage\.parent names a run without a backbone"):
        check(compose(["stage=flow_map", "data=pairs"]), parent=Parent(gan, Path("gan")))
    with pytest.raises(InputError, match="stage=gan has its own network: leave the backbone out"):
        check(compose([*command, asked]), [*command, asked])
