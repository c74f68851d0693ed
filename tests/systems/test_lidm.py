"""LiDM against its published code: autoencoder, quantiser, U-Net, diffusion, losses, data and
checkpoints.
"""

import json
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import torch.nn.functional as F
import yaml
from torch import Tensor, nn

from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.base.registry import options_of
from r2flow.data.detection import reading_for
from r2flow.generators import build_generator
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import project, unproject
from r2flow.lidar.sensors import build_sensor
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.config import ModelConfig
from r2flow.model.lineage import Parent
from r2flow.runs.composing import CONF
from r2flow.samplers import build_sampler
from r2flow.systems.diffusion.process import PREDICTIONS, noised, walk
from r2flow.systems.diffusion.schedules import square_root_linear
from r2flow.systems.latent.autoencoder import Autoencoder
from r2flow.systems.latent.generator import _some_of
from r2flow.systems.latent.published import _autoencoder, _unet, _within
from r2flow.systems.latent.quantiser import Quantiser
from r2flow.systems.latent.stage import (
    LearnAutoencoder,
    LearnLatentDiffusion,
    _adversarial_factor,
    _reconstruction_loss,
    returns,
)
from r2flow.systems.latent.unet import LatentUNet
from r2flow.training import check, compose
from tests.reference import (
    assert_near,
    assert_norms,
    assert_published,
    load_case,
    published_names,
    shapes_of,
)

SMALL_AUTOENCODER = {
    "width": 32,
    "multipliers": [1, 1],
    "strides": [[2, 2]],
    "blocks": 1,
    "codes": 16,
}
SMALL_UNET = {"width": 32, "multipliers": [1, 2], "blocks": 1, "attention": [2]}
TINY: dict[str, Any] = {
    "sensor": {"name": "hdl64e", "rows": 8, "columns": 32, "min_range": 1.0, "max_range": 56.0},
    "encoding": {"format": "shifted_log", "reflectance": False, "limits": "open"},
    "backbone": {"name": "latent_unet"},
}
DIFFUSION = {
    **TINY,
    "generator": {"name": "latent_diffusion", "autoencoder": SMALL_AUTOENCODER, "unet": SMALL_UNET},
}
AUTOENCODER = {**TINY, "generator": {"name": "vq_autoencoder", "autoencoder": SMALL_AUTOENCODER}}


def autoencoder_of(cfg: dict[str, Any]) -> Autoencoder:
    inner = cfg["ddconfig"]
    return Autoencoder(
        inner["in_channels"], inner["ch"], inner["ch_mult"], inner["strides"], inner["num_res_blocks"],
        inner["attn_levels"], inner["z_channels"], cfg["embed_dim"], cfg["n_embed"], legacy=True, mask=cfg["use_mask"],
    )  # fmt: skip


def unet_of(cfg: dict[str, Any]) -> LatentUNet:
    return LatentUNet(
        (cfg["in_channels"], *cfg["image_size"]), cfg["model_channels"], cfg["channel_mult"], cfg["num_res_blocks"],
        cfg["attention_resolutions"], cfg["num_head_channels"],
    )  # fmt: skip


@pytest.fixture(scope="module")
def diffusion(shared: Path) -> dict[str, Any]:
    case = load_case(shared, "lidm_diffusion.pt")
    case["unet"] = unet_of(case["unet_cfg"])
    case["autoencoder"] = autoencoder_of(case["cfg"]["first_stage_config"]["params"])
    case["unet"].load_state_dict(_within(case["state_dict"], "model.diffusion_model."))
    case["autoencoder"].load_state_dict(_within(case["state_dict"], "first_stage_model."))
    case["log_snr"] = square_root_linear()
    return case


def test_autoencoder_and_gradients_are_the_published(shared: Path):
    case = load_case(shared, "lidm_ae_16x64.pt")
    model = autoencoder_of(case["cfg"])
    model.load_state_dict(case["state_dict"])
    indices, sure = case["outputs"].pop("indices"), case["index_margin"] > 1e-5

    def call(given: dict[str, Tensor]) -> dict[str, Tensor]:
        before, (made, loss) = model.encode(given["x"]), model(given["x"])
        assert torch.equal(
            model.quantize.nearest(before.movedim(1, -1)).flatten()[sure], indices[sure]
        )
        return {
            "prequant": before, "quant": model.quantize(before)[0], "codebook_loss": loss, "reconstruction": made,
            "interface_decoded": model.decode(before), "interface_decoded_unquantised": model.decode(before, False),
        }  # fmt: skip

    assert_published(model, case, 5e-5, call)


@pytest.mark.parametrize("name", ["legacy", "corrected"])
def test_quantiser_and_gradients_are_the_published(shared: Path, name: str):
    case = load_case(shared, "lidm_vq.pt")
    quantiser = Quantiser(*case["codebook"].shape, beta=case["beta"], legacy=name == "legacy")
    quantiser.load_state_dict({"embedding.weight": case["codebook"]})
    z, expected = case["z"].clone().requires_grad_(), case["cases"][name]
    codes, loss = quantiser(z)
    sure = case["index_margin"] > 1e-5
    assert torch.equal(quantiser.nearest(z.movedim(1, -1)).flatten()[sure], case["indices"][sure])
    assert_near(codes, case["quant"], 1e-6)
    assert_near(loss, expected["loss"], 1e-6)
    (0.1 * (codes * case["grad_w"]).sum() + 3 * loss).backward()
    assert_near(z.grad, expected["grad_z"], 1e-6)
    assert_near(quantiser.embedding.weight.grad, expected["grad_codebook"], 1e-6)


def test_the_nearest_code_is_the_nearest_under_autocast():
    draw = torch.Generator().manual_seed(0)
    quantiser, vectors = Quantiser(512, 8), torch.randn(2000, 8, generator=draw)
    with torch.no_grad():
        quantiser.embedding.weight.copy_(torch.randn(512, 8, generator=draw))
    expected = torch.cdist(vectors.double(), quantiser.embedding.weight.detach().double()).argmin(1)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(quantiser.nearest(vectors), expected)


def test_unet_and_gradients_are_the_published(shared: Path):
    case = load_case(shared, "lidm_unet_8x16.pt")
    model = unet_of(case["cfg"])
    model.load_state_dict(case["state_dict"])
    assert_published(model, case, 2e-5, lambda given: model(given["x"], given["t"]))


def test_the_full_networks_have_the_published_names_and_shapes(shared: Path):
    with torch.device("meta"):
        autoencoder, unet = Autoencoder(), LatentUNet((8, 16, 128))
    names = published_names(shared, "lidm")
    for prefix, model in (("first_stage_model.", autoencoder), ("model.diffusion_model.", unet)):
        assert shapes_of(model) == _within(names, prefix)


def test_a_learned_bias_is_added_after_the_first_convolution():
    torch.manual_seed(0)
    plain = LatentUNet((8, 4, 8), **SMALL_UNET).double()
    torch.nn.init.normal_(plain.out[-1].weight)
    positioned = LatentUNet((8, 4, 8), **SMALL_UNET, position="learnable").double()
    positioned.load_state_dict({**plain.state_dict(), "position": torch.zeros(32, 4, 8)})
    z, t = torch.randn(2, 8, 4, 8, dtype=torch.float64), torch.tensor([3, 500])
    assert torch.equal(positioned(z, t), plain(z, t))
    # A constant bias is that of the convolution itself.
    with torch.no_grad():
        positioned.position.copy_(torch.arange(32.0)[:, None, None].expand(32, 4, 8))
        plain.input_blocks[0][0].bias += torch.arange(32.0)
    torch.testing.assert_close(positioned(z, t), plain(z, t), rtol=0, atol=1e-9)


def test_objective_and_gradients_are_the_published(diffusion: dict[str, Any]):
    case, unet = diffusion["objective"], diffusion["unet"]
    z = noised(case["x_start"], diffusion["log_snr"][case["t"]], case["noise"])
    assert_near(z, case["x_t"], 1e-5)
    loss = (unet(z, case["t"]) - case["noise"]).square().flatten(1).mean(1)
    assert_near(loss, case["per_sample"], 1e-5)
    # by the stage, at the steps of uniform draws, of scans that the autoencoder makes x_start
    stage = LearnLatentDiffusion(generator=build_generator(DIFFUSION))
    stage.generator.model["diffusion_model"] = unet
    stage.generator.first_stage_model.encode = lambda x: case["x_start"]
    batch = {"x_1": torch.zeros(3, 1, 8, 32), "x_0": case["noise"]}
    loss = stage.regression_loss(batch, (case["t"] + 0.5) / 1000)
    assert_near(loss, case["loss"], 1e-5)
    loss.backward()
    assert_norms(unet, case["grad_param_norms"], prefix="diffusion_model.")


@pytest.mark.parametrize("name", ["ddim_10_eta0", "ddim_10_eta1"])
@torch.no_grad()
def test_ddim_is_the_published(diffusion: dict[str, Any], name: str):
    """The walk that `LatentDDIM` takes, and the data that each of its steps expects."""
    case, log_snr, decode = (
        diffusion["cases"][name],
        diffusion["log_snr"],
        diffusion["autoencoder"].decode,
    )
    times = _some_of(len(log_snr), case["steps"])

    def clean(z: Tensor, t: Tensor) -> Tensor:
        return PREDICTIONS["eps"].split(z, diffusion["unet"](z, t.expand(len(z))), log_snr[t])[0]

    snrs, noise = log_snr[[*times.tolist(), 0]], lambda k: case["noise"][k - 1]
    states = [case["x_T"], *walk(clean, case["x_T"], snrs, case["eta"], noise, times)]
    for k, t in enumerate(times):
        assert_near(clean(states[k], t), case["pred_x0"][k], 1e-4)
        assert_near(states[k + 1], case["x_trajectory"][k + 1], 1e-4)
    assert_near(decode(states[-1]), case["decoded"], 1e-4)
    assert_near(decode(states[-1], False), case["decoded_unquantised"], 1e-4)


@pytest.mark.parametrize("name", ["S50", "S30", "S7"])
def test_subsets_of_steps_are_the_published(diffusion: dict[str, Any], name: str):
    case, times = diffusion["ddim_tables"][name], _some_of(1000, int(name[1:])).flip(0)
    assert torch.equal(times, case["timesteps"])
    alphas = diffusion["log_snr"].sigmoid()
    assert_near(alphas[times], case["alphas"], 1e-5)
    assert_near(alphas[[0, *times[:-1].tolist()]], case["alphas_prev"], 1e-5)


@pytest.mark.parametrize("step", [0, 1, 2])
def test_a_training_step_has_the_published_losses_and_gradients(
    shared: Path, monkeypatch: pytest.MonkeyPatch, step: int
):
    """Of the stage, with the case's autoencoder: a convolution of features by its last weights."""
    case = load_case(shared, "lidm_ae_loss.pt")
    cfg = case["cfg"]
    stage: Any = LearnAutoencoder(
        generator=build_generator(AUTOENCODER),
        discriminator={"width": cfg["disc_ndf"], "layers": cfg["disc_num_layers"]},
        adversarial_weight=cfg["disc_weight"],
        adversarial_start=cfg["disc_start"],
        codebook_weight=cfg["codebook_weight"],
        inverted=True,
    )
    last = nn.Parameter(case["last_layer"].clone())
    stage.autoencoder = nn.Module()
    stage.autoencoder.mask = False
    stage.autoencoder.decoder = nn.ModuleDict({"conv_out": nn.Module()})
    stage.autoencoder.decoder["conv_out"].weight = last
    stage.autoencoder.forward = lambda x: (F.conv2d(case["features"], last), case["codebook_loss"])
    model = stage.discriminator
    losses = []

    def take_step(name: str, loss: Tensor) -> None:
        stage.zero_grad()
        expected = case["cases"][f"step{step}_{name}"]
        losses.append(loss.item())
        assert losses[-1] == pytest.approx(expected["loss"], rel=1e-4)
        loss.backward()
        assert_norms(model, expected["grad_disc_norms"])
        if name == "ae":
            assert_near(last.grad, expected["grad_last_layer"], 1e-3)

    model.load_state_dict(case["discriminator"])
    monkeypatch.setattr(LearnAutoencoder, "global_step", step)
    stage.own_optimizers = lambda: ("ae", "disc")
    stage.take_step = take_step
    stage.log = lambda name, value, **_: losses.append(torch.as_tensor(value).item())
    stage.training_step({"x_1": case["inputs"]}, 0)
    log = case["cases"][f"step{step}_ae"]["log"]
    assert losses[2:4] == pytest.approx([log["train/rec_loss"], log["train/quant_loss"]], rel=1e-5)


def test_the_discriminator_begins_at_its_step_and_ends_there_as_published():
    assert [_adversarial_factor(step, 2) for step in range(5)] == [0, 0, 1, 1, 1]
    assert [_adversarial_factor(step, 2, inverted=True) for step in range(5)] == [1, 1, 1, 0, 0]


def test_ranges_and_masks_are_encoded_and_decoded_as_published(shared: Path):
    case = load_case(shared, "lidm_data.pt")
    sensor = build_sensor("hdl64e", 16, 64, *case["depth_range"])
    encoding = Encoding(sensor, "shifted_log", reflectance=False)
    assert encoding.format.scale == case["depth_scale"]
    x = encoding.encode(case["metres"][None])
    # The published code encodes ranges beyond the limits too; to ours they are no returns.
    metres = case["metres"]
    inside = (metres >= sensor.min_range) & (metres <= sensor.max_range)
    assert_near(x * inside, case["model_space"] * inside, 1e-6)
    mask = returns(x[None], encoding)[0]
    assert torch.equal(mask[:, inside], case["mask"][:, inside])
    assert (mask[:, ~inside] == -1).all()
    encoding = Encoding(sensor, "shifted_log", reflectance=False, limits="open")
    decoded = encoding.decode(case["sample"][None])[0]
    assert torch.equal(decoded > 0, case["sample_valid"])
    assert_near(decoded, torch.where(case["sample_valid"], case["sample_metres"], 0), 1e-6)
    points = unproject(decoded[None, None], sensor.rays("reference"))[0][:, case["sample_valid"]].T
    assert_near(points, case["sample_points"], 1e-6)


@pytest.fixture
def published(shared: Path, tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    io = load_case(shared, "lidm_published_io.pt")
    path = Path(
        shutil.copy(shared / "oracle_baselines" / "lidm_published.ckpt", tmp_path / "model.ckpt")
    )
    images = {
        "size": [16, 32],
        "fov": [3, -25],
        "depth_range": [1.0, 56.0],
        "depth_scale": 5.84,
        "log_scale": True,
    }
    config = {"model": {"params": io["cfg"]}, "data": {"params": {"dataset": images}}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    return path, io


@pytest.mark.parametrize("averaged", [True, False])
def test_a_published_diffusion_gives_its_noise_and_images(
    published: tuple[Path, dict[str, Any]], averaged: bool
):
    path, io = published
    loaded = load_checkpoint(path, averaged=averaged)
    generator = loaded.generator
    assert generator.space.shape == (1, 16, 32)
    assert loaded.step == 1234
    assert generator.sampler == build_sampler("latent_ddim", steps=50, eta=1.0)
    with torch.no_grad():
        assert_near(
            generator.unet(io["z"], io["t"]),
            io["output_ema" if averaged else "output_weights"],
            5e-5,
        )
        assert_near(generator.first_stage_model.encode(io["x"]), io["latent"], 5e-5)
        assert_near(generator.first_stage_model.decode(io["z"]), io["decoded"], 5e-5)


def test_a_published_diffusion_without_its_config_has_its_own_schedule(
    shared: Path, tmp_path: Path, caplog: Any
):
    content = load_case(shared, "lidm_published.ckpt")
    betas = torch.linspace(0.0012345678**0.5, 0.0195**0.5, 1000, dtype=torch.float64) ** 2
    torch.save(
        {**content, "state_dict": {**content["state_dict"], "betas": betas.float()}},
        tmp_path / "model.ckpt",
    )
    loaded = load_checkpoint(tmp_path / "model.ckpt")
    assert_near(loaded.generator.log_snr, torch.logit((1 - betas).cumprod(0)), 2e-7)
    assert (
        "64 x 1024, ranges of 1 to 56 m on a logarithmic scale, attention heads of 32"
        in caplog.text
    )
    assert loaded.generator.space.shape == (1, 64, 1024)
    assert loaded.config.generator["unet"]["head_channels"] == 32
    assert loaded.config.generator["schedule"]["last"] == 0.0195


@pytest.mark.parametrize("name", ["use_new_attention_order", "scale_by_std"])
def test_an_option_that_changes_the_images_and_is_not_read_is_refused(
    published: tuple[Path, Any], name: str
):
    config = yaml.safe_load((notes := published[0].with_name("config.yaml")).read_text())
    params = config["model"]["params"]
    (params if name == "scale_by_std" else params["unet_config"]["params"])[name] = True
    notes.write_text(yaml.safe_dump(config))
    with pytest.raises(InputError, match=name):
        load_checkpoint(published[0])


def test_points_fall_into_the_published_pixels(
    published: tuple[Path, dict[str, Any]], shared: Path
):
    case = load_case(shared, "lidm_data.pt")
    sensor = build_sensor("hdl64e", 16, 64, *case["depth_range"])
    chosen = yaml.safe_load((CONF / "data" / "kitti_360_lidm.yaml").read_text())
    readings = chosen["reading"], chosen["validation"]["data"]["reading"]
    for how in (
        reading_for([], load_checkpoint(published[0])).convention,
        *(r["convention"] for r in readings),
    ):
        image = torch.from_numpy(project(case["points"].numpy(), None, sensor, convention=how))[0]
        assert_near(torch.where(image > 0, image, -1.0), case["proj_range"], 1e-6)


def test_callback_states_keyed_by_their_class_are_read(
    shared: Path, tmp_path: Path, monkeypatch: Any
):
    """As Lightning 1.4.2 wrote them; the class is not imported."""
    place = "pytorch_lightning.callbacks.model_checkpoint"
    key = type("ModelCheckpoint", (), {"__module__": place})
    with monkeypatch.context() as patch:
        for name in ("pytorch_lightning", "pytorch_lightning.callbacks", place):
            patch.setitem(sys.modules, name, ModuleType(name))
        sys.modules[place].ModelCheckpoint = key
        content = load_case(shared, "lidm_ae_published.ckpt")
        torch.save(
            {**content, "callbacks": {key: {"best_model_path": "a"}}}, tmp_path / "model.ckpt"
        )
    assert load_checkpoint(tmp_path / "model.ckpt").config.generator["name"] == "vq_autoencoder"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({}, {}),
        (
            {
                "multipliers": (2, 1, 2),
                "strides": ((1, 2), (1, 2)),
                "blocks": 3,
                "attention": (1,),
                "mask": True,
            },
            {"multipliers": (1, 2, 3), "blocks": 1, "attention": (2,), "width": 64},
        ),
    ],
)
def test_options_are_read_off_the_names_and_shapes_of_weights(
    first: dict[str, Any], second: dict[str, Any]
):
    with torch.device("meta"):
        autoencoder, unet = Autoencoder(1, **first), LatentUNet((8, 16, 128), **second)
    usual = options_of(Autoencoder, given=1), options_of(LatentUNet, given=1)
    for read, model, given, known in (
        (_autoencoder, autoencoder, {**first, "legacy": True}, usual[0]),
        (_unet, unet, second, usual[1]),
    ):
        for name, value in read(model.state_dict()).items():
            # lists for tuples
            assert value == json.loads(json.dumps({**known, **given}[name])), name


def test_a_published_config_that_contradicts_is_one_line(published: tuple[Path, dict[str, Any]]):
    path, _ = published
    text = path.with_name("config.yaml").read_text()
    for what, instead, said in (
        ("5.84", "6.5", "'depth_scale': 6.5"),
        ("- -25", "- -30", r"'fov': \[3, -30\]"),
    ):
        path.with_name("config.yaml").write_text(text.replace(what, instead))
        with pytest.raises(InputError, match=said):
            load_checkpoint(path)
    content = torch.load(path, weights_only=True)
    path.with_name("config.yaml").unlink()
    for name, said in (
        ("betas", "betas are not evenly spaced"),
        ("cond_stage_model.w", "only LiDM's unconditional"),
    ):
        content["state_dict"][name] = torch.linspace(0.0015, 0.0195, 1000)
        torch.save(content, path)
        with pytest.raises(InputError, match=said):
            load_checkpoint(path)


@pytest.mark.parametrize("averaged", [False, True])
def test_a_published_autoencoder_gives_its_codes(shared: Path, tmp_path: Path, averaged: bool):
    io, content = (load_case(shared, f"lidm_ae_published{end}") for end in ("_io.pt", ".ckpt"))
    if averaged:
        averages = {
            f"model_ema.{name.replace('.', '')}": value
            for name, value in content["state_dict"].items()
        }
        content["state_dict"] = {
            name: 2 * value for name, value in content["state_dict"].items()
        } | averages
    torch.save(content, tmp_path / "model.ckpt")
    model = load_checkpoint(tmp_path / "model.ckpt").generator.first_stage_model
    with torch.no_grad():
        (made, loss), before = model(io["x"]), model.encode(io["x"])
    assert_near(before, io["prequant"], 5e-5)
    assert_near(made, io["reconstruction"], 5e-5)
    assert_near(loss, io["codebook_loss"], 5e-5)
    assert (
        model.quantize.nearest(before.movedim(1, -1)).flatten() == io["indices"]
    ).float().mean() > 0.99


def test_an_autoencoder_where_scans_are_wanted_is_one_line(r2flow, shared: Path, tmp_path: Path):
    path = shared / "oracle_baselines" / "lidm_ae_published.ckpt"
    code, _, error = r2flow("sample", path, "-o", tmp_path / "out")
    warning, line = error.splitlines()
    assert (code, warning.startswith("WARNING"), "a VQAutoencoder draws no scans" in line) == (
        2,
        True,
        True,
    )
    assert not (tmp_path / "out").exists()
    assert "\nsampler " not in r2flow("info", path).said


def test_a_latent_diffusion_starts_from_its_autoencoder_alone():
    torch.manual_seed(0)
    generator, parent = build_generator(DIFFUSION), build_generator(AUTOENCODER)
    before = generator.unet.state_dict()
    generator.start_from(parent)
    own = generator.first_stage_model.state_dict()
    assert all(
        torch.equal(own[name], value)
        for name, value in parent.first_stage_model.state_dict().items()
    )
    assert all(
        torch.equal(before[name], value) for name, value in generator.unet.state_dict().items()
    )
    other = {**AUTOENCODER["generator"], "autoencoder": {**SMALL_AUTOENCODER, "codes": 32}}
    with pytest.raises(InputError, match="do not fit"):
        generator.start_from(build_generator({**AUTOENCODER, "generator": other}))


@pytest.mark.parametrize(
    ("changes", "said"), [({"name": "ddpm"}, "denoise"), ({"steps": 1000}, "in 1 to 999")]
)
def test_a_sampler_that_a_latent_diffusion_does_not_have_is_refused(
    changes: dict[str, Any], said: str
):
    with pytest.raises(InputError, match=said):
        build_generator(DIFFUSION).choose(**changes)


def test_scans_of_a_diffusion_in_bfloat16_have_all_digits():
    generator, draws = build_generator(DIFFUSION).eval(), Draws(0, [0])
    noise, sampler = draws.start(generator.noise_shape), build_sampler("latent_ddim", steps=2)
    x = generator(noise, sampler=sampler, draws=draws, precision="bf16-mixed").x
    assert x.dtype == torch.float32
    assert not torch.equal(x, x.bfloat16().float())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"autoencoder": {**SMALL_AUTOENCODER, "strides": [[1, 2], [2, 2]]}}, "needs 1 strides"),
        (
            {"autoencoder": {"multipliers": [1], "strides": []}, "unet": {"multipliers": [1] * 5}},
            r"\) halves images 4",
        ),
        (
            {"unet": {"position": "polar"}, "autoencoder": SMALL_AUTOENCODER},
            "'none' or 'learnable', found 'polar'",
        ),
        (
            {"autoencoder": {"multipliers": [], "strides": []}},
            "multipliers: value should have at least 1 item",
        ),
        (
            {"autoencoder": {**SMALL_AUTOENCODER, "strides": [[1]]}},
            "needs the option .strides.0.1",
        ),
        ({"schedule": {"name": "cosine", "steps": 1}}, "steps: must be at least 2, found 1"),
        (
            {"schedule": {"name": "square_root_linear", "last": 2.0}},
            r"last: must be in \(0, 1\), found 2",
        ),
    ],
)
def test_sizes_that_cannot_work_are_one_line(change: dict[str, Any], said: str):
    with torch.device("meta"), pytest.raises(InputError, match=said):
        build_generator({**TINY, "generator": {"name": "latent_diffusion", **change}})


def test_a_masked_autoencoder_drops_what_its_mask_denies():
    torch.manual_seed(0)
    model = Autoencoder(1, **SMALL_AUTOENCODER, mask=True)
    z = torch.randn(2, 8, 4, 16)
    raw, decoded = model.decoder(model.post_quant_conv(z)), model.decode(z, quantise=False)
    assert raw.shape == (2, 2, 8, 32)
    assert (decoded[raw[:, 1:] < 0] == -1).all()
    assert torch.equal(decoded[raw[:, 1:] >= 0], raw[:, :1][raw[:, 1:] >= 0])
    x, mask = torch.rand(2, 1, 8, 32), torch.ones(2, 1, 8, 32)
    expected = ((x - raw[:, :1]).abs().mean() + 0.5 * (1 - raw[:, 1:]).abs().mean()) / 2
    torch.testing.assert_close(_reconstruction_loss(x, raw, mask, 0.5), expected)


FULL = {"lidargen": 29_694_082, "lidm_autoencoder": 15_070_361, "r2dm": 31_099_650}


@pytest.mark.parametrize("name", FULL)
def test_a_published_recipe_is_built(name: str, tmp_path: Path):
    options = ["data.root=/nowhere", "trainer.accelerator=cpu", f"run_dir={tmp_path}"]
    if name != "lidm_autoencoder":
        options.append("encoding.reflectance=true")  # or the scans decide it
    config = check(compose([f"experiment={name}", *options]))
    with torch.device("meta"):
        assert sum(p.numel() for p in build_generator(config.plain()).parameters()) == FULL[name]


def test_the_published_recipe_with_positions_starts_from_its_autoencoder(tmp_path: Path):
    common = ["data.root=/nowhere", "trainer.accelerator=cpu", f"run_dir={tmp_path}"]
    with pytest.raises(InputError, match="starts from a trained model: give parent=RUN"):
        check(compose(["experiment=lidm", "stage.parent=null", *common]))
    first = ["experiment=lidm_autoencoder", *common]
    config = check(
        compose(["experiment=lidm_ape", *common]),
        parent=Parent(ModelConfig(compose(first)), tmp_path),
    )
    # the paper's
    data = config.data
    assert (data.name, data.split, data.drives) == ("kitti_360", "train", None)
    with torch.device("meta"):
        assert (
            sum(p.numel() for p in build_generator(config.plain()).parameters())
            == 15_070_361 + 257_751_560 + 524_288
        )
