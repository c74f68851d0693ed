"""Every system: scan i is a function of its number alone, and published files are taken by the
verbs as they are.
"""

import json
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from r2flow.base.noise import Draws
from r2flow.generators import build_generator
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.paths import checkpoints_of
from r2flow.model.tensor_files import read_checkpoint
from r2flow.samplers import build_sampler
from tests.conftest import refused
from tests.systems.test_lidm import SMALL_AUTOENCODER, SMALL_UNET
from tests.training.conftest import hold_at, in_process, stop_held

SENSOR = {"name": "hdl64e", "rows": 8, "columns": 32}
GAN = {"latent": 8, "base_channels": 4, "doublings": 2}
SYSTEMS: dict[str, tuple[dict[str, Any], str, int]] = {
    "vanilla_gan": (GAN, "direct", 1),
    "dusty1": (GAN, "direct", 1),
    "dusty2": (GAN, "direct", 1),
    "diffusion": ({}, "ddpm:steps=5", 5),
    "score": ({"width": 4, "levels": 3}, "langevin:steps=5", 3 * 5 + 1),
    # 1000 // 7 = 142 goes 8 times into 1000
    "latent_diffusion": (
        {"autoencoder": SMALL_AUTOENCODER, "unet": SMALL_UNET},
        "latent_ddim:steps=7",
        8,
    ),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_scan_is_a_function_of_its_number_alone(name: str):
    torch.manual_seed(0)
    options, text, evaluations = SYSTEMS[name]
    backbone = {
        "name": "efficient_unet",
        "base_channels": 8,
        "channel_multiplier": [1, 2],
        "num_residual_blocks": 1,
    }
    config = {
        "sensor": SENSOR, "encoding": {"format": "logscale", "reflectance": False}, "backbone": backbone,
        "generator": {"name": name, **options},
    }  # fmt: skip
    generator, sampler = build_generator(config).eval(), build_sampler(text)
    three, one = Draws(0, [4, 5, 6]), Draws(0, [5])
    with torch.device("meta"):  # a default device of the user's
        many, alone = (
            generator(d.start(generator.noise_shape), draws=d, sampler=sampler)
            for d in (three, one)
        )
    torch.testing.assert_close(many.x[1:2], alone.x, rtol=0, atol=1e-4)
    assert not torch.allclose(many.x[0], many.x[1])
    assert many.x.shape == (3, 1, 8, 32)
    assert many.x.abs().max() <= 1 or name == "latent_diffusion"  # whose decoder has no bound
    assert many.evaluations.tolist() == [evaluations] * 3
    assert sampler.evaluations(generator) == evaluations
    # as in 64-true runs
    wide = generator(one.start(generator.noise_shape).double(), draws=one, sampler=sampler)
    torch.testing.assert_close(wide.x.float(), alone.x, rtol=0, atol=1e-4)
    double = generator.double()(one.start(generator.noise_shape), draws=one, sampler=sampler)
    torch.testing.assert_close(double.x.float(), alone.x, rtol=0, atol=1e-4)


# Options, and the evaluations that a scan takes: steps x noise levels and one to take the last
# noise off.
FILES = {
    "vanilla_published.pth": ([], 1),
    "dusty1_published.pth": ([], 1),
    "dusty2_published.pth": ([], 1),
    "r2dm_published.pth": (["--steps", 2], 2),
    "lidargen_published.pth": (["--steps", 1], 10 + 1),
    "lidm_published.ckpt": (["--steps", 1], 1),
}
LARGE = ("lidargen_published.pth", "lidm_published.ckpt")  # of 64 x 1024


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in LARGE else ()) for n in FILES]
)
def test_a_published_file_is_sampled_and_evaluated(r2flow, shared, tmp_path: Path, name: str):
    path = shared / "oracle_baselines" / name
    if not path.exists():
        pytest.skip("the reference checkpoint is not here")
    options, evaluations = FILES[name]
    out = tmp_path / "scans"
    assert r2flow(
        "sample", path, *options, "--num", 2, "--pictures", 0, "--device", "cpu", "--out", out
    ).said
    assert (out / "000001.npy").is_file()
    alone = [
        "--num",
        2,
        "--metrics",
        "jsd",
        "--no-reference",
        "--no-baselines",
        "--workers",
        0,
        "--device",
        "cpu",
    ]
    assert r2flow("evaluate", out, path, *options, *alone, "--json", tmp_path / "e.json").said
    (found,) = json.loads((tmp_path / "e.json").read_text())["comparisons"]
    assert found["generated"]["num"] == 2
    # The same sampler and seed, but the noise of evaluation, which no sample has.
    assert 0 <= found["metrics"][0]["figures"]["jsd"] <= 0.8326
    speed = next(metric for metric in found["metrics"] if metric["metric"] == "speed")
    assert speed["figures"]["evaluations"] == evaluations


TINY = [
    "sensor.rows=16", "sensor.columns=64", "data.scenes=8", "data.batch_size=2", "trainer.accelerator=cpu",
    "trainer.max_steps=6", "trainer.val_check_interval=3", "trainer.log_every_n_steps=1", "callbacks.pictures=null",
    "samples.num=0", "loggers=[csv]",
]  # fmt: skip
FLOW = [*TINY, "callbacks.checkpoint.every=2", "stage.warmup_images=4"]
FAMILIES = {
    "diffusion": ["experiment=r2dm", "size=small", *FLOW, "backbone.base_channels=8"],
    "score": ["experiment=lidargen", "size=small", *FLOW, "generator.width=4", "generator.levels=4"],
    "autoencoder": [
        "experiment=lidm_autoencoder", "size=small", *TINY, "callbacks.checkpoint.every=2",
        "generator.autoencoder.codes=16", "stage.adversarial_start=2",
    ],
    "latent": ["experiment=lidm", "size=small", *FLOW, "generator.autoencoder.codes=16", "stage.parent=first"],
    "gan": [
        "experiment=dusty2", "size=small", *TINY, "callbacks.checkpoint.every=2", "generator.base_channels=4",
        "stage.discriminator.base_channels=4", "stage.warmup.images=4", "stage.augment.initial=0.5",
        "stage.augment.kimg=0.1", "stage.augment.every=2", "stage.r1_every=2",
    ],
}  # fmt: skip
FIRST = [
    "experiment=lidm_autoencoder",
    "size=small",
    *TINY,
    "trainer.max_steps=3",
    "generator.autoencoder.codes=16",
]

# bit-equal, whatever is nested in what
assert_equal = partial(torch.testing.assert_close, rtol=0, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_a_killed_system_ends_as_the_one_left_alone(tmp_path: Path, family: str):
    if family == "latent":
        in_process(tmp_path, [*FIRST, "run_dir=first"])
    options, held = FAMILIES[family], tmp_path / "held"
    in_process(tmp_path, [*options, "run_dir=alone"])
    killed = [*options, "run_dir=killed", *hold_at(5, held)]
    code, said = stop_held(held, signal.SIGKILL, killed)
    assert code == -signal.SIGKILL, said
    assert checkpoints_of(tmp_path / "killed")[0].name == "step-00000004.ckpt"
    assert "resuming from" in in_process(tmp_path, killed).stdout
    one, other = (
        read_checkpoint(checkpoints_of(tmp_path / name)[0]) for name in ("alone", "killed")
    )
    assert one["global_step"] == other["global_step"]
    # not all runs have an average
    for part in {"state_dict", "current_model_state", "optimizer_states"} & one.keys():
        assert_equal(one[part], other[part])
    if family == "latent":  # its autoencoder stays as it is
        first = load_checkpoint(tmp_path / "first").generator.first_stage_model
        assert_equal(
            first.state_dict(),
            load_checkpoint(tmp_path / "alone").generator.first_stage_model.state_dict(),
        )


def garble(part: str, **changes: Any) -> Callable[[Any], None]:
    """Change or, with None, remove entries of a published config, in a part such as
    `model.generator`.
    """

    def change(cfg: Any) -> None:
        for key in filter(None, part.split(".")):
            cfg = cfg[int(key) if key.isdigit() else key]
        for key, value in changes.items():
            cfg.pop(key) if value is None else cfg.update({key: value})

    return change


OUTPUT = "model.generator.synthesis_kwargs.out_ch.0"
GARBLED = [
    ("dusty2", garble("model.generator", arch="stylegan"), "KeyError: 'stylegan'"),
    ("dusty2", garble("model.generator.synthesis_kwargs", output_scale=1.0), "output_scale"),
    ("dusty2", garble("dataset", max_depth=1.0), "needs 0 < min_range < max_range"),
    ("dusty2", garble(OUTPUT, act="os.system"), "KeyError: 'os.system'"),
    ("r2dm", garble("data", min_depth=90.0), "needs 0 < min_range < max_range"),
    (
        "r2dm",
        garble("diffusion", timestep_type="discrete"),
        "only diffusions of range in continuous time",
    ),
    (
        "r2dm",
        garble("model", architecture="refinenet"),
        "no backbone named 'refinenet'",
    ),
    ("r2dm", garble("diffusion", noise_schedule="sigmoid"), "no log-SNR schedule named 'sigmoid'"),
    ("lidargen", None, "KeyError: 'network.sigmas'"),
]


@pytest.mark.parametrize(("name", "change", "said"), GARBLED)
def test_a_published_file_that_is_not_understood_is_one_line(shared, tmp_path, name, change, said):
    content: Any = [{"module.begin_conv.weight": torch.zeros(4, 4, 3, 3)}, {}, 1, 2, {}]
    if change is not None:
        content = torch.load(
            shared / "oracle_baselines" / f"{name}_published.pth", weights_only=False
        )
        change(content["cfg"])
    torch.save(content, tmp_path / "it.pth")
    with refused(said):
        load_checkpoint(tmp_path / "it.pth")
