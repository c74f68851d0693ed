"""The vanilla GAN, DUSty v1 and DUSty v2: networks, losses, rules, augmentation, data, published
files and training.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from r2flow.callbacks.ema import HalfLifeEMA, half_life_decay
from torch import nn

from r2flow.base.errors import InputError
from r2flow.generators import build_generator
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import unproject
from r2flow.lidar.sensors import SENSORS
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.tensor_files import read_checkpoint
from r2flow.reports.training import read_curves
from r2flow.systems.gan import dcgan, style_discriminator, style_gan
from r2flow.systems.gan.augment import (
    TRANSFORMATIONS,
    AdaptiveAugment,
    BatchDraws,
    _coloured,
    affine,
    transformed,
)
from r2flow.systems.gan.dcgan import DustyV1, VanillaGan
from r2flow.systems.gan.layers import _straight_through_mask, logistic
from r2flow.systems.gan.stage import (
    LearnGan,
    Warmup,
    _blurred,
    _discriminator_loss,
    _generator_loss,
    _lazy_adam,
    r1,
)
from r2flow.systems.gan.style_gan import DustyV2
from r2flow.training import build, compose, fit
from tests.reference import (
    assert_near,
    assert_norms,
    assert_published,
    load_case,
    published_names,
    shapes_of,
)
from tests.training.conftest import start

NETWORKS = [
    "vanilla_g_32x64", "dusty1_g_32x64", "dusty1_g_32x64_2ch", "dusty2_g_32x64_eval", "dusty2_g_32x64_train",
]  # fmt: skip
PUBLISHED = ["vanilla", "dusty1", "dusty2"]


def space(rows: int, columns: int, channels: int = 1) -> Any:
    return SimpleNamespace(shape=(channels, rows, columns), rays=torch.zeros(2, rows, columns))


def generator_of(cfg: Mapping[str, Any]) -> nn.Module:
    synthesis, mapping = cfg["synthesis_kwargs"], cfg["mapping_kwargs"]
    out = {one["name"]: one for one in synthesis["out_ch"]}
    given = space(*synthesis["resolution"], out["image"]["ch"])
    widths = {
        "latent": mapping["in_ch"], "base_channels": synthesis["ch_base"], "max_channels": synthesis["ch_max"]
    }  # fmt: skip
    if cfg["arch"] == "dusty_v2":
        return DustyV2(
            given, **widths, depth=mapping["depth"], doublings=len(synthesis["layers"])
        ).network
    return (DustyV1 if "raydrop_logit" in out else VanillaGan)(given, **widths).network


@pytest.mark.parametrize("name", NETWORKS)
def test_a_generator_is_the_published_one(shared: Path, name: str):
    case, tolerance = load_case(shared, f"{name}.pt"), 1e-4 if "dusty2" in name else 2e-5
    network = generator_of(case["cfg"]).train(case["mode"] == "train")
    assert list(network.state_dict()) == list(case["state_dict"])
    network.load_state_dict(case["state_dict"])
    given = case["inputs"]
    more = {
        key: given.get(name) for key, name in (("uniform", "uniform"), ("shift", "shift_fraction"))
    }
    made = assert_published(
        network, case, tolerance, lambda at: network(at["z"], at.get("angle"), **more)
    )
    if "uniform" in given:
        assert torch.equal(made["raydrop_mask"], case["outputs"]["raydrop_mask"])
        torch.testing.assert_close(
            logistic(given["uniform"]), given["logistic_noise"], rtol=1e-5, atol=1e-6
        )
    after = network.state_dict()
    for key, expected in case.get("buffers_after", {}).items():
        torch.testing.assert_close(after[key], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", ["vanilla_d_32x64", "dusty2_d_64x64"])
def test_a_discriminator_is_the_published_one_with_its_penalty(shared: Path, name: str):
    case, tolerance = load_case(shared, f"{name}.pt"), 1e-4 if "dusty2" in name else 2e-5
    layer, module = (
        case["cfg"]["layer_kwargs"],
        style_discriminator if case["cfg"]["arch"] == "dusty_v2" else dcgan,
    )
    widths = {"base_channels": layer["ch_base"], "max_channels": layer["ch_max"]}
    network = module.Discriminator(tuple(layer["resolution"]), layer["in_ch"], **widths)
    assert list(network.state_dict()) == list(case["state_dict"])
    network.load_state_dict(case["state_dict"])
    assert_published(network, case, tolerance, lambda given: network(given["x"]))

    expected = case["r1"]
    network.zero_grad()
    x = case["inputs"]["x"].clone().requires_grad_()
    scores = network(x)
    (slope,) = torch.autograd.grad(scores.sum(), x, retain_graph=True)
    penalty = r1(scores, x)
    penalty.backward()
    assert_near(slope, expected["grad_x_of_score_sum"], 1e-4)
    assert penalty.item() == pytest.approx(expected["penalty"], rel=1e-4)
    torch.testing.assert_close(x.grad, expected["grad_x_of_penalty"], rtol=1e-3, atol=1e-7)
    assert_norms(network, expected["grad_param_norms"])


FULL = {
    "vanilla_G": VanillaGan, "vanilla_D": dcgan.Discriminator, "dusty_v1_G": DustyV1,
    "dusty_v1_D": dcgan.Discriminator, "dusty_v2_G": DustyV2, "dusty_v2_D": style_discriminator.Discriminator,
}  # fmt: skip
SIZES = {"": (64, 512, 1), "_64x1024_2ch": (64, 1024, 2)}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", FULL)
def test_full_size_networks_have_the_published_names_and_shapes(shared: Path, name: str, size: str):
    build, (*shape, channels) = FULL[name], SIZES[size]
    with torch.device("meta"):
        network = (
            build(tuple(shape), channels)
            if name.endswith("_D")
            else build(space(*shape, channels)).network
        )
    assert shapes_of(network) == published_names(shared, f"{name}{size}")


def test_an_image_that_cannot_be_halved_so_often_is_refused():
    for shape in ((40, 512), (16, 64)):
        with pytest.raises(InputError, match="multiples of 16, at least 32"):
            VanillaGan(space(*shape))


GANS = [(DustyV1, dcgan.Discriminator), (DustyV2, style_discriminator.Discriminator)]


@pytest.mark.parametrize(("gan", "critic"), GANS)
def test_codes_masks_and_scores_stay_float32_in_half_precision(gan: Any, critic: Any):
    generator, discriminator = (
        gan(space(32, 64), latent=8, base_channels=4),
        critic((32, 64), base_channels=4),
    )
    with torch.autocast("cpu", torch.bfloat16):
        made = generator.made(torch.randn(2, 8), torch.rand(2, 1, 32, 64))
        scores = discriminator(made["image"])
    assert {value.dtype for value in (*made.values(), scores)} == {torch.float32}


def test_a_turn_by_whole_columns_is_a_roll():
    x = torch.randn(2, 1, 3, 8)
    expected = torch.stack([x[0].roll(-2, 2), x[1].roll(-5, 2)])
    torch.testing.assert_close(style_gan._turned_back(x, torch.tensor([2 / 8, 5 / 8])), expected)


def test_losses_and_their_gradients(shared: Path):
    case = load_case(shared, "gan_losses.pt")
    for name, loss in (
        ("nsgan_G", lambda real, fake: _generator_loss(fake)),
        ("nsgan_D", _discriminator_loss),
    ):
        expected = case["cases"][name]
        real, fake = (case[key].clone().requires_grad_() for key in ("y_real", "y_fake"))
        found = loss(real, fake)
        found.backward()
        assert found.item() == pytest.approx(expected["loss"], rel=1e-6)
        for tensor, key in ((real, "grad_y_real"), (fake, "grad_y_fake")):
            if expected[key] is None:
                assert tensor.grad is None
            else:
                torch.testing.assert_close(tensor.grad, expected[key], rtol=1e-6, atol=1e-8)


def test_a_mask_is_drawn_with_its_probability_and_has_the_relaxed_gradient():
    logit = torch.full((200_000,), math.log(3.0), requires_grad=True)
    noise = logistic(torch.rand(200_000))
    mask = _straight_through_mask(logit, noise, 0.5)
    assert set(mask.tolist()) == {0.0, 1.0}
    assert mask.mean().item() == pytest.approx(0.75, abs=4 * (0.75 * 0.25 / 200_000) ** 0.5)
    mask.sum().backward()
    soft = torch.sigmoid((logit + noise) / 0.5).detach()
    torch.testing.assert_close(logit.grad, soft * (1 - soft) / 0.5)


def test_rules_of_training(shared: Path):
    case = load_case(shared, "gan_training_rules.pt")
    ema = case["ema_decay"]
    found = [
        half_life_decay(step, ema["batch_size"], 1000 * ema["ema_kimg"], ema["rampup"])
        for step in ema["iteration"]
    ]
    torch.testing.assert_close(
        torch.tensor(found, dtype=torch.float64), ema["decay"], rtol=1e-6, atol=0
    )
    callback = HalfLifeEMA()
    callback.batch_size, callback._step = 32, 6250
    assert callback._decay() == pytest.approx(0.5 ** (32 / 10_000))
    for who, every in (("generator", 0), ("discriminator", 16)):
        rate, betas = _lazy_adam(0.002, (0.0, 0.99), every)
        assert rate == pytest.approx(case["adam"][who]["lr"], rel=1e-12)
        assert betas == pytest.approx(case["adam"][who]["betas"], rel=1e-12)
    assert case["r1_weight"] == 1.0 * 16 / 2
    dropout, warmup = case["warmup_dropout"], Warmup()
    left = [warmup.dropout * warmup.left(images) for images in dropout["images"]]
    assert left == pytest.approx(dropout["ratio"], abs=1e-12)
    applied = case["warmup_dropout_apply"]
    uniform = torch.where(applied["keep"] > 0, 0.1, 0.9)  # of which a share of 0.5 is dropped
    assert torch.equal(warmup(applied["x"], 0, uniform), applied["y"])
    blur = case["warmup_blur"]
    assert_near(_blurred(blur["x"], blur["sigma"]), blur["y"], 1e-6)
    assert torch.equal(Warmup(images=100, blur=1.7)(blur["x"], 100, None), blur["x"])


def test_p_of_ada_follows_the_published_trace(shared: Path):
    case = load_case(shared, "gan_training_rules.pt")["ada_p"]
    augment = AdaptiveAugment(
        case["p_target"], case["kimg"], highest=case["p_max"], every=case["every"]
    )
    signs, found = [], []
    for step, scores in enumerate(case["preds"]):
        augment.count(scores)
        if step % augment.every == 0:
            signs.append(float(augment.move()))
            found.append(float(augment.p))
    assert signs == pytest.approx(case["rt"], rel=1e-6)
    assert found == pytest.approx(case["p"], rel=1e-6)


@pytest.mark.parametrize("number", [0, 1])
def test_augmentation_is_the_published_one(shared: Path, number: int):
    case = load_case(shared, "ada_transforms.pt")["cases"][number]
    names = [name for name in (*TRANSFORMATIONS, "hue", "saturation") if case["policy"].get(name)]
    drawn = [tensor.float() for _, tensor in case["draws"]]
    x = case["x"].clone().requires_grad_()
    draws = {name: torch.full((len(x),), one.identity) for name, one in TRANSFORMATIONS.items()}
    for name, value, applies in zip(names, drawn[::2], drawn[1::2], strict=True):
        if name in TRANSFORMATIONS:
            draws[name] = torch.where(applies > 0, value, TRANSFORMATIONS[name].identity)
    scale, shift = affine(draws, *x.shape[-2:])
    maps = torch.diag_embed(torch.cat([scale.flip(0), torch.ones(1, len(x))]).T)
    maps[:, :2, 2] = shift.flip(0).T  # the published maps have columns before rows
    assert_near(maps, case["affine"], 1e-4)
    y = _coloured(transformed(x, scale, shift), draws)
    assert_near(y, case["y"], 1e-4)
    (y * case["grad_w"]).sum().backward()
    assert_near(x.grad, case["grad_x"], 1e-4)


def draws_of(count: int) -> BatchDraws:
    return BatchDraws(0, {"k": torch.arange(count), "x_1": torch.empty(0)}, 0)


def test_augmentation_draws_the_published_distributions():
    draws = AdaptiveAugment(initial=1.0).draw(draws_of(10_000))
    assert list(draws) == list(TRANSFORMATIONS)
    for name, draw in AdaptiveAugment(initial=0.4).draw(draws_of(10_000)).items():
        applied = draw == draws[name]
        assert (applied | (draw == TRANSFORMATIONS[name].identity)).all()
        share = (
            (applied.float().mean().item() - 0.5) * 2
            if "flip" in name
            else applied.float().mean().item()
        )
        assert share == pytest.approx(0.4, abs=0.015), name
    for name, mean, deviation in (
        ("lr_flip", 0.5, 0.5), ("int_trans", 0.0, 0.25 / 12**0.5), ("frac_trans", 0.0, 0.125), ("brightness", 0.0, 0.2),
        ("luma_flip", 0.5, 0.5),
    ):  # fmt: skip
        values = draws[name]
        assert values.mean().item() == pytest.approx(
            mean, abs=5 * deviation / len(values.flatten()) ** 0.5
        ), name
        assert values.std().item() == pytest.approx(deviation, rel=0.03), name
    for name, octaves in (("iso_scale", 0.2), ("contrast", 0.5)):
        assert draws[name].log2().std().item() == pytest.approx(octaves, rel=0.03), name
    assert draws["int_trans"].shape == draws["frac_trans"].shape == (2, 10_000)


def test_augmentation_of_probability_0_keeps_the_image():
    augment = AdaptiveAugment(initial=0.0)
    x = torch.randn(2, 1, 8, 16)
    assert_near(augment(x, augment.draw(draws_of(2))), x, 0.05)  # the filter alone, there and back


def test_whole_shifts_on_a_ring_are_rolls_where_the_filter_lets_all_pass():
    # far below the filter's limit
    x = torch.sin(torch.arange(64) * 2 * math.pi * 3 / 64).expand(1, 1, 8, 64)
    assert_near(transformed(x, torch.ones(2, 1), torch.tensor([[0.0], [5.0]])), x.roll(5, 3), 1e-3)


def test_data_are_the_published_ones(shared: Path):
    case = load_case(shared, "dusty_data.pt")
    sensor = SENSORS["hdl64e_rings"].resized(16, 64)
    assert (sensor.min_range, sensor.max_range) == (case["min_depth"], case["max_depth"])
    encoding = Encoding(sensor, "inverse_depth", reflectance=False)
    torch.testing.assert_close(
        encoding.encode(case["metres"] * case["mask"]), case["model_space"], rtol=1e-5, atol=0
    )
    torch.testing.assert_close(
        encoding.format.forward(case["metres"]), case["inv_depth_norm"], rtol=1e-5, atol=0
    )
    metres = encoding.decode(case["sample"])
    torch.testing.assert_close(metres, case["sample_metres"].abs(), rtol=1e-5, atol=0)
    torch.testing.assert_close(
        unproject(metres, case["angle"][0]), case["sample_points"], rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("name", PUBLISHED)
@pytest.mark.parametrize("averaged", [True, False])
def test_a_published_file_is_a_generator(shared: Path, name: str, averaged: bool):
    io = load_case(shared, f"{name}_published_io.pt")
    checkpoint = load_checkpoint(
        shared / "oracle_baselines" / f"{name}_published.pth", averaged=averaged
    )
    assert checkpoint.config.stored["published"] == io["cfg"]
    assert checkpoint.step == 1_000_000 // 32
    assert (
        sum(p.numel() for p in checkpoint.generator.network.parameters())
        == io["num_parameters"]["G"]
    )
    made = checkpoint.generator.made(io["z"], io["uniform"], truncation=io["truncation_psi"])
    apart = (made["image"] - io["outputs"]["image"]).abs().max() / io["outputs"][
        "image"
    ].abs().max()
    assert (apart < 1e-4) == averaged
    if averaged:
        for key, expected in io["outputs"].items():
            assert_near(made[key], expected, 1e-4)


def test_sensor_and_angles_of_a_published_file_are_its_own_also_when_saved(
    shared: Path, tmp_path: Path
):
    checkpoint = load_checkpoint(shared / "oracle_baselines" / "dusty2_published.pth")
    rays = checkpoint.sensor.rays()
    torch.testing.assert_close(checkpoint.generator.angle[0], rays, rtol=0, atol=1e-4)
    assert math.degrees(float(rays[0, 0, 0])) == pytest.approx(math.degrees(0.05), abs=1e-3)
    checkpoint.save(tmp_path / "it.safetensors")
    saved = load_checkpoint(tmp_path / "it.safetensors")
    assert saved.sensor == checkpoint.sensor
    assert torch.equal(saved.sample(1), checkpoint.sample(1))


TINY = [
    "sensor.rows=16", "sensor.columns=32", "data.scenes=8", "data.batch_size=4", "generator.latent=8",
    "generator.base_channels=4", "stage.discriminator.base_channels=4", "stage.r1_every=2", "stage.augment.every=2",
    "stage.augment.initial=0.5", "stage.augment.kimg=0.1", "encoding.reflectance=true", "trainer.accelerator=cpu",
]  # fmt: skip


def tiny(system: str) -> dict[str, Any]:
    return compose([f"experiment={system}", "size=small", *TINY])


def test_truncation_by_0_is_refused_and_by_less_draws_codes_together():
    generator = build_generator(tiny("dusty2")).eval()
    z = torch.randn(16, 8)
    generator.network.w_avg.copy_(torch.randn(1, 8))
    whole, half = (
        generator.made(z, torch.rand(16, 1, 16, 32), truncation=psi)["w"] for psi in (1.0, 0.5)
    )
    torch.testing.assert_close(
        half, generator.network.w_avg + 0.5 * (whole - generator.network.w_avg)
    )
    for truncation in (0.0, 2.0, "x", float("nan")):
        with pytest.raises(InputError, match="truncation"):
            generator.choose(truncation=truncation)
    for wrong in ({"name": "euler"}, {"steps": 2}):
        with pytest.raises(InputError):
            generator.choose(**wrong)


def test_each_row_of_the_log_has_the_augmentation_of_its_step_and_the_last_penalty(tmp_path: Path):
    options = [
        "experiment=dusty2", "size=small", *TINY, "trainer.max_steps=5", "trainer.log_every_n_steps=1", "loggers=[csv]",
        f"run_dir={tmp_path}", "callbacks.pictures=null", "samples.num=0",
    ]  # fmt: skip
    run = build(compose(options))
    stage: Any = run.stage
    expected: list[float] = []
    stage.on_train_batch_end = lambda *_: expected.append(float(stage.augment.p))
    fit(run)
    curves = read_curves(tmp_path, ("train/augmented", "train/last_r1"))
    assert curves["train/augmented"][1].tolist() == pytest.approx(expected)
    assert len(set(expected)) == 3  # in five steps it moves after every second
    assert [len(set(each)) for each in curves["train/last_r1"]] == [4, 2]
    assert fit(
        build(compose([*options, f"stage.parent={tmp_path}", f"run_dir={tmp_path / 'tuned'}"]))
    ).finished


def test_a_training_step_has_the_losses_of_the_scores_that_it_sees(
    monkeypatch: pytest.MonkeyPatch,
):
    stage: Any = LearnGan(
        generator=build_generator(tiny("dusty1")), discriminator={"name": "dcgan", "base_channels": 4, "halvings": 2},
        augment=None, warmup={"images": 0}, r1=0.5, r1_every=1,
    )  # fmt: skip
    seen: list[tuple[torch.Tensor, torch.Tensor]] = []
    stage.discriminator.register_forward_hook(lambda _, x, y: seen.append((x[0], y.detach())))
    losses = {}
    stage.own_optimizers = lambda: ("generator", "discriminator")
    stage.take_step = lambda name, loss: losses.setdefault(name, []).append(loss.item())
    stage.log = lambda *_, **__: None
    monkeypatch.setattr(LearnGan, "images_per_step", 4)
    real = torch.rand(4, *stage.space.shape)
    stage.training_step({"x_1": real, "x_0": torch.randn(4, 8), "k": torch.arange(4)}, 0)
    (shown, fooled), (scan, right), (fake, wrong), (penalised, _) = seen
    assert torch.equal(scan, real)
    assert torch.equal(penalised.detach(), real)
    assert shown.shape == fake.shape == real.shape
    assert not torch.equal(shown, fake)
    # of `gan_losses.pt`, whose forms they are by another test
    x = real.clone().requires_grad_()
    (slope,) = torch.autograd.grad(stage.discriminator(x).sum(), x)
    assert losses == {
        "generator": pytest.approx([_generator_loss(fooled).item()]),
        "discriminator": pytest.approx(
            [
                _discriminator_loss(right, wrong).item(),
                0.5 * 1 / 2 * slope.square().sum((1, 2, 3)).mean().item(),
            ]
        ),
    }


@pytest.mark.slow
def test_two_processes_equal_one(tmp_path: Path):
    runs = {}
    for name, more in (("one", []), ("two", ["trainer.devices=2", "trainer.strategy=ddp"])):
        options = [
            "experiment=dusty2", "size=small", *TINY, "trainer.max_steps=3", "data.batch_size=8",
            f"run_dir={tmp_path / name}", "callbacks.pictures=null", "samples.num=0", *more,
        ]  # fmt: skip
        process = start(tmp_path, options)
        said, _ = process.communicate(timeout=300)
        assert process.returncode == 0, said
        runs[name] = read_checkpoint(tmp_path / name / "checkpoints" / "step-00000003.ckpt")
    one, two = runs["one"], runs["two"]
    assert torch.equal(
        one["current_model_state"]["augment.p"], two["current_model_state"]["augment.p"]
    )
    for name, value in one["current_model_state"].items():
        # Adam with beta_1 = 0 takes steps of the rate's size whatever the gradient's: 2e-3 a step.
        torch.testing.assert_close(
            two["current_model_state"][name], value, rtol=0, atol=2e-4, msg=name
        )
