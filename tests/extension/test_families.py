"""A GAN, a conditional flow and a backbone from files outside the package: every verb."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.export import tableau
from r2flow.model.paths import checkpoints_of
from r2flow.model.sampling import sample
from r2flow.samplers import build_sampler
from tests.extension.conftest import (
    BACKBONE,
    COMPLETION,
    FAMILIES,
    GAN,
    TINY,
    Family,
    loaded,
    r2flow,
    run_of,
    train,
)  # fmt: skip
from tests.training.test_train import assert_bit_equal


def test_training_leaves_pictures_checkpoints_and_samples(trained: tuple[Family, Path]):
    _, run = trained
    assert [path.name for path in sorted((run / "pictures").iterdir())] == [
        "step-00000003.png",
        "step-00000006.png",
    ]
    assert [path.name for path in checkpoints_of(run)] == [
        "step-00000006.ckpt",
        "step-00000004.ckpt",
    ]
    image = np.load(run / "samples" / "000000.npy")
    assert image.shape == (2, 16, 64)
    assert np.isfinite(image).all()


def test_a_run_goes_on_from_its_checkpoint_bit_by_bit(trained: tuple[Family, Path], tmp_path: Path):
    family, run = trained
    stopped = Path(shutil.copytree(run, tmp_path / "stopped"))
    checkpoints_of(stopped)[0].unlink()  # as if killed between steps 4 and 6
    assert "resuming from" in train(stopped, family).stdout
    assert_bit_equal(run, stopped)


def test_info_names_the_family(trained: tuple[Family, Path]):
    family, run = trained
    about = json.loads(r2flow("info", run, "--json", family.plugin).said)
    expected = {
        GAN: ("toy_gan", None), COMPLETION: ("toy_completion", "hdit"),
        BACKBONE: ("rectified_flow", "toy_backbone"),
    }  # fmt: skip
    assert (about["generator"], about["backbone"]) == expected[family]
    # which has a network of its own kind
    assert (about["config"]["backbone"] is None) == (family is GAN)
    assert about["config"]["plugins"] == [str(FAMILIES / f"{family.file}.py")]
    # options of its stage, without a file of theirs: as given, as it says, as of every stage
    if family is GAN:
        assert [about["config"]["stage"][key] for key in ("width", "learning_rate", "parent")] == [
            16,
            2e-3,
            None,
        ]


def test_samples_are_measured(trained: tuple[Family, Path], tmp_path: Path):
    family, run = trained
    how = (
        "--metrics",
        "jsd",
        "--num",
        2,
        "--real-num",
        2,
        "--workers",
        0,
        "--steps",
        "1,2",
    )
    assert (
        "JSD"
        in r2flow(
            "evaluate", family.plugin, "simulated:7", run, *how, "--json", tmp_path / "e.json"
        ).said
    )
    comparisons = json.loads((tmp_path / "e.json").read_text())["comparisons"]
    steps = [
        one["generated"]["sampler"].get("steps") for one in comparisons if one["kind"] == "judged"
    ]
    assert steps == ([None] if family is GAN else [1, 2])


def test_weights_travel_as_safetensors(trained: tuple[Family, Path], tmp_path: Path):
    family, run = trained
    file = tmp_path / "it.safetensors"
    said = r2flow("export", family.plugin, run, "--to", "safetensors", "-o", file).said
    assert hashlib.sha256(file.read_bytes()).hexdigest() in said
    with loaded(family):
        there, here = load_checkpoint(run).generator, load_checkpoint(file).generator
    assert here.sampler == there.sampler
    torch.testing.assert_close(here.state_dict(), there.state_dict(), rtol=0, atol=0)


def test_a_flow_is_straightened(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory):
    run = Path(shutil.copytree(run_of(BACKBONE, tmp_path_factory), tmp_path / "run"))
    sampler = ("data.pairs.sampler.name=euler", "data.pairs.sampler.steps=2")
    pairs = ("data.pairs.num=6", "data.pairs.batch_size=3", *sampler)
    tiny = [one for one in TINY if not one.startswith("data.scenes")]  # which are of scans
    options = [
        BACKBONE.plugin,
        *tiny,
        "sampler.steps=2",
        *pairs,
        f"stage.parent={run}",
        f"run_dir={tmp_path / 'two'}",
    ]
    assert r2flow("train", "experiment=reflow", *options).said
    with loaded(BACKBONE):
        first, second = load_checkpoint(run), load_checkpoint(tmp_path / "two")
    assert second.config.stage.name == "reflow"
    assert type(second.generator).__name__ == type(first.generator).__name__
    assert second.generator.state_dict().keys() == first.generator.state_dict().keys()


CANNOT = {
    "interpolate": (
        ["RUN", "SCAN", "SCAN", "-o", "OUT"], "needs the velocity of a flow from noise; a ToyGenerator"
    ),
    "report "
    "curvature": (["RUN", "-o", "OUT"], "curvature needs the velocity of a flow from noise; a ToyGenerator"),
    "report solvers": (["RUN", "-o", "OUT"], "report solvers needs the velocity of a flow"),
    "export": (["RUN", "-o", "OUT.onnx", "--steps", "4"], "only rectified flows and flow maps can be exported"),
    "pairs": (["RUN"], "a reflow pair needs the velocity of a flow from noise; a ToyGenerator"),
    "sample": (["RUN", "--steps", "4", "-o", "OUT"], "no option 'steps'"),
}  # fmt: skip


@pytest.mark.parametrize("verb", CANNOT)
def test_what_a_gan_cannot_do_is_one_line(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, verb: str
):
    gan, (arguments, said) = run_of(GAN, tmp_path_factory), CANNOT[verb]
    for name, value in (
        ("RUN", gan),
        ("SCAN", gan / "samples" / "000000.ply"),
        ("OUT", tmp_path / "out"),
    ):
        arguments = [one.replace(name, str(value)) for one in arguments]
    assert said in r2flow(*verb.split(), GAN.plugin, *arguments).refusal
    assert not list(tmp_path.iterdir())


SHRUNKEN = Family("sampler", "toy_sampler", ("sampler={name: shrunken, steps: 3, share: 0.25}",))


@pytest.fixture(scope="module")
def shrunken_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    shrunken_run = tmp_path_factory.mktemp("sampler") / "run"
    given = [
        "sampler.name=shrunken",
        "sampler.steps=3",
        "+sampler.share=0.25",
        "trainer.max_steps=2",
    ]
    options = [
        "data=simulated",
        "backbone=hdit_tiny",
        *TINY,
        *given,
        SHRUNKEN.plugin,
        f"run_dir={shrunken_run}",
    ]
    assert r2flow("train", *options).said
    return shrunken_run


def test_a_checkpoint_notes_it_and_needs_the_plugin(shrunken_run: Path, tmp_path: Path):
    with loaded(SHRUNKEN):
        generator = load_checkpoint(shrunken_run).generator
        assert generator.sampler == build_sampler("shrunken", steps=3, share=0.25)
        noise = Draws(0, [0]).start(generator.noise_shape)
        euler = generator(noise, sampler=build_sampler("euler", steps=1)).x
        made = generator(noise, sampler=build_sampler("shrunken", steps=1, share=0.25))
        torch.testing.assert_close(made.x, noise + 0.25 * (euler - noise))
        assert made.evaluations.tolist() == [1]
        found = tableau(generator, build_sampler("shrunken", steps=2, share=0.5))
        torch.testing.assert_close(
            found.states, torch.tensor([[1, 0, 0], [1, 0.25, 0], [1, 0.25, 0.25]]).double()
        )
        with pytest.raises(InputError, match="share"):
            build_sampler("shrunken", share="x")
    assert "--plugin" in r2flow("sample", shrunken_run, "-o", tmp_path / "out").refusal


def test_verbs_take_it(shrunken_run: Path, tmp_path: Path):
    given = (SHRUNKEN.plugin, shrunken_run, "--sampler", "shrunken:share=0.75", "--steps", 2)
    assert r2flow(
        "sample", *given, "--num", 1, "--format", "npy", "--pictures", 0, "-o", tmp_path / "scans"
    ).said
    assert np.isfinite(np.load(tmp_path / "scans" / "000000.npy")).all()
    note = json.loads((tmp_path / "scans" / "manifest.json").read_text())["recipe"]["sampler"]
    assert note == {"name": "shrunken", "steps": 2, "grid": "uniform", "share": 0.75}
    assert r2flow("pairs", *given, "--num", 2, "--batch-size", 2, "-o", tmp_path / "pairs").said
    assert "shrunken" in r2flow("info", shrunken_run, SHRUNKEN.plugin).stdout


def test_known_rays_are_given_back_and_the_others_depend_on_them(
    tmp_path_factory: pytest.TempPathFactory,
):
    with loaded(COMPLETION):
        checkpoint = load_checkpoint(run_of(COMPLETION, tmp_path_factory))
    space = checkpoint.generator.space
    mask = torch.zeros(2, 1, 16, 64)
    mask[:, :, ::2] = 1
    for image in (torch.full((2, *space.shape), 0.5), torch.full((2, *space.shape), -0.5)):
        known = {"image": image, "mask": mask}
        alone = torch.cat(
            [one.images for one in sample(checkpoint, 2, batch_size=1, condition=known)]
        )
        together = next(sample(checkpoint, 2, batch_size=2, condition=known)).images
        torch.testing.assert_close(alone, together, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(
            alone[:, :, ::2], space.decode(image)[:, :, ::2], rtol=1e-5, atol=1e-5
        )
    assert not torch.allclose(
        next(sample(checkpoint, 2, batch_size=2)).images[:, :, 1::2], alone[:, :, 1::2]
    )
