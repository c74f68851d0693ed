"""Larger networks out of trained ones."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.maps import jump
from r2flow.generators import FlowMap, Sampler, build_generator
from r2flow.generators.budgets import Budget
from r2flow.growing import grown, widened
from r2flow.model.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, weights_hash
from tests.test_checkpoints import CONFIG, saved  # noqa: F401  a fixture
from tests.test_cli import r2flow  # noqa: F401  a fixture

MEASURED = (Budget(8, (0.01, 0.02), (0.1, 0.4), (0.05, 0.06)),)
STREET_LIKE = {**CONFIG, "backbone": {**CONFIG["backbone"], "position": "none"}}


def flow(**changes: object) -> Checkpoint:
    config = {**STREET_LIKE, **changes}
    found = Checkpoint(build_generator(config).eval(), config)
    for parameter in found.generator.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return found


def means(x: Tensor) -> Tensor:
    return torch.nn.functional.avg_pool2d(x, (2, 4))


@pytest.mark.parametrize("generator", ["rectified_flow", "flow_map"])
def test_it_follows_the_trained_flow_in_the_means_of_its_images(generator):
    """Means of x_t are a state of the trained flow at t' = t sqrt(n) / w, w = t sqrt(n) + 1 - t, times w / sqrt(n): the
    trained flow's velocity there, with this factor's rate of change, is theirs."""
    small = flow(generator={"name": generator})
    large = grown(small, (16, 256))
    assert large.sensor.shape == (16, 256)
    x, root = torch.randn(3, 2, 16, 256), 8**0.5
    for t in (0.0, 0.2, 0.9):
        w = t * root + 1 - t
        y = means(x) * root / w
        # d(w / root y) / dt = (root - 1) / root y + w / root y' dt' / dt, dt' / dt = root / w^2
        with torch.no_grad():
            expected = (root - 1) / root * y + small.generator.velocity(torch.tensor(t * root / w), y) / w
            found = means(large.generator.velocity(torch.tensor(t), x))
        assert torch.allclose(found, expected, atol=1e-5)


def test_the_means_of_a_grown_map_jump_as_the_map_does():
    """Means of x_s are a state of the map at s', as those of x_t at t'."""
    small = flow(generator={"name": "flow_map"})
    large = grown(small, (16, 256))
    assert type(large.generator) is FlowMap
    x, root = torch.randn(3, 2, 16, 256), 8**0.5
    for times in ((0.0, 1.0), (0.2, 0.7), (0.6, 0.6)):
        t, s = torch.tensor(times)
        w_t, w_s = (time * root + 1 - time for time in (t, s))
        y = means(x) * root / w_t
        with torch.no_grad():
            expected = jump(small.generator.mean_velocity, t * root / w_t, y, s * root / w_s) * w_s / root
            found = means(jump(large.generator.mean_velocity, t, x, s))
        assert torch.allclose(found, expected, atol=1e-5)


def test_a_grown_map_learns_on_as_a_map(r2flow, tmp_path):  # noqa: F811
    small = flow(generator={"name": "flow_map"})
    save_checkpoint(small, tmp_path / "map.safetensors")
    out, run = tmp_path / "larger.safetensors", tmp_path / "run"
    assert r2flow("grow", tmp_path / "map.safetensors", out, "--size", "16x128")[0] == 0
    said = r2flow(
        *("train", "experiment=flow_map", f"stage.init={out}", f"run_dir={run}", "data.pairs.num=4", "trainer=cpu"),
        *("data.pairs.steps=2", "trainer.max_steps=2", "data.batch_size=2", "samples.num=0", "callbacks.pictures=null"),
    )
    assert said[0] == 0, said
    found = load_checkpoint(run)
    assert type(found.generator) is FlowMap
    assert found.config["parent"]["grown_from"]["weights"] == weights_hash(small)


def test_it_is_the_same_every_time_and_other_draws_go_on_as_they_would():
    small, state = flow(), torch.random.get_rng_state()
    first = weights_hash(grown(small, (16, 128)))
    assert torch.equal(torch.random.get_rng_state(), state)
    torch.rand(1)
    assert weights_hash(grown(small, (16, 128))) == first


@pytest.mark.parametrize("shape", [(8, 64), (8, 100), (12, 64), (4, 32), (16, 63)])
def test_a_size_that_is_no_multiple(shape):
    with pytest.raises(InputError, match=r"images of 8x64 cannot grow to .* such as 16x256"):
        grown(flow(), shape)


def test_other_generators_do_not_grow():
    with pytest.raises(InputError, match="holds a ConditionalFlow; only a flow of whole scans can grow"):
        grown(flow(generator={"name": "conditional_flow"}), (16, 128))


def test_flows_that_know_some_times_alone_do_not_grow():
    small = flow()
    small.generator.sampler = Sampler("euler", 2, fixed=True)
    with pytest.raises(InputError, match="grow the flow that it was distilled from"):
        grown(small, (16, 128))


def test_rings_do_not_grow():
    small = flow()
    published = Checkpoint(small.generator, {**small.config, "published": {}, "data": {"projection": "unfolding"}})
    with pytest.raises(InputError, match="whose rings have no rows between them"):
        grown(published, (16, 128))


def test_a_diffusion_has_no_time_for_a_pyramid():
    large = grown(flow(), (16, 128))
    with pytest.raises(InputError, match="a pyramid needs the time of straight lines"):
        build_generator({**large.config, "generator": {"name": "diffusion"}})


def test_a_grown_flow_is_trained_and_drawn_from(r2flow, saved, tmp_path):  # noqa: F811
    path, _ = saved
    out = tmp_path / "larger.safetensors"
    code, said, _ = r2flow("grow", path, out, "--size", "16x128")
    assert code == 0
    assert f"r2flow train experiment=finetune stage.init={out}" in said
    run = [
        f"stage.init={out}",
        f"run_dir={tmp_path / 'run2'}",
        "data=simulated",
        "data.scenes=4",
        "trainer.max_steps=2",
    ]
    code, _, said = r2flow("train", "experiment=finetune", *run, "data.root=null", "trainer=cpu", "samples.num=1")
    assert code == 0, said
    trained = load_checkpoint(tmp_path / "run2")
    assert trained.config["backbone"]["name"] == "pyramid"
    assert trained.sensor.shape == (16, 128)
    assert trained.config["parent"]["weights"] == weights_hash(load_checkpoint(out))
    assert trained.config["parent"]["grown_from"]["weights"] == weights_hash(load_checkpoint(path))
    code, said, _ = r2flow("info", tmp_path / "run2", "--card")
    assert code == 0
    assert f"grown from a rectify flow of 7 steps, weights {weights_hash(load_checkpoint(path))}" in said
    code, _, said = r2flow("grow", path, tmp_path / "larger.ckpt", "--size", "16x128")
    assert (code, "give a .safetensors" in said) == (2, True)


@pytest.mark.parametrize("before", [None, [1, 8], [2, 8]])
@pytest.mark.parametrize("generator", ["rectified_flow", "flow_map"])
def test_a_wider_one_draws_the_same(generator, before):
    small = flow(generator={"name": generator}, backbone={**STREET_LIKE["backbone"], "detail": before})
    small.generator.sampler = Sampler("euler", 3)
    small = replace(small, accuracy=MEASURED)
    wider = widened(small, (3, 24))
    assert type(wider.generator) is type(small.generator)
    assert wider.config["backbone"]["detail"] == [3, 24]
    assert wider.config["parent"]["weights"] == weights_hash(small)
    assert wider.accuracy == small.accuracy == MEASURED  # the same scans have the same errors
    expected = small.sample(2)
    assert expected.std() > 1
    assert torch.allclose(wider.sample(2), expected, atol=1e-3)  # metres


def test_a_wider_pyramid_draws_the_same():
    small = grown(flow(), (16, 128), detail=[1, 8])
    torch.nn.init.normal_(small.generator.get_parameter("backbone.detail.answer.weight"), std=0.1)
    t, x = torch.tensor(0.9), torch.randn(1, 2, 16, 128)
    with torch.no_grad():
        expected = small.generator.velocity(t, x)
        assert torch.allclose(widened(small, (2, 16)).generator.velocity(t, x), expected, atol=1e-5)


def test_all_that_is_new_can_learn():
    """Of new channels and new blocks no weight is without a gradient for good: after one step all have one."""
    network = widened(flow(backbone={**STREET_LIKE["backbone"], "detail": [1, 8]}), (2, 16)).generator.backbone.train()
    optimiser = torch.optim.SGD(network.parameters(), lr=0.1)
    for _ in range(3):
        optimiser.zero_grad()
        network(torch.rand(2), torch.randn(2, 2, 8, 64)).square().mean().backward()
        optimiser.step()
    for name, parameter in network.detail.named_parameters():
        rows = parameter.grad.flatten(1) if parameter.ndim > 1 else parameter.grad[:, None]
        assert (rows != 0).any(1).all(), name


@pytest.mark.parametrize("size", [(1, 24), (3, 8), (-1, 24), (0, 0)])
def test_it_cannot_shrink(size):
    with pytest.raises(InputError, match=r"has 2 blocks of 16 channels at full resolution and cannot shrink to"):
        widened(flow(backbone={**STREET_LIKE["backbone"], "detail": [2, 16]}), size)


def test_a_network_without_convolutions_at_full_resolution_does_not_widen():
    unet = {"name": "efficient_unet", "base_channels": 16, "time_channels": 16}
    with pytest.raises(InputError, match="holds a network of the kind efficient_unet; hdit and pyramid have"):
        widened(flow(backbone=unet), (2, 16))


def test_a_wider_one_from_the_command_line(r2flow, saved, tmp_path):  # noqa: F811
    path, _ = saved
    out = tmp_path / "wider.safetensors"
    code, said, _ = r2flow("grow", path, out, "--detail", "2,8")
    assert (code, "2 blocks of 8 channels at full resolution; it draws the same scans" in said) == (0, True)
    assert load_checkpoint(out).config["backbone"]["detail"] == [2, 8]
    code, _, _ = r2flow("grow", path, tmp_path / "both.safetensors", "--size", "16x128", "--detail", "2,8")
    assert code == 0
    assert load_checkpoint(tmp_path / "both.safetensors").config["backbone"]["detail"] == [2, 8]
    for options, problem in (
        ([], "nothing to grow: give --size, as 64x1024, --detail, as 6,48, or --position."),
        (["--detail", "6"], "--detail must be blocks and channels, as 6,48; found '6'."),
        (["--detail", "1,-8"], "detail must be 2 integers of at least 1, found [1, -8]."),
    ):
        code, _, said = r2flow("grow", path, tmp_path / "none.safetensors", *options)
        assert (code, problem in said) == (2, True), said


def test_how_scans_became_images_is_kept_and_unfolded_ones_are_refused():
    read = {"name": "folder", "projection": "spherical", "convention": "reference", "reflectance_scale": 255.0}
    known = {key: value for key, value in read.items() if key != "name"}
    assert widened(flow(data=read), (2, 16)).config["data"] == known
    assert grown(flow(data=read), (16, 128)).config["data"] == known
    small = flow()
    rings = Checkpoint(small.generator, {**small.config, "published": {}, "data": {"projection": "unfolding"}})
    with pytest.raises(InputError, match="trained on unfolded scans"):
        widened(rings, (2, 16))


def test_the_card_of_what_has_not_learned_yet(r2flow, saved, tmp_path):  # noqa: F811
    out = tmp_path / "wider.safetensors"
    assert r2flow("grow", saved[0], out, "--detail", "2,8")[0] == 0
    code, said, _ = r2flow("info", out, "--card")
    assert (code, "| starts from | a rectify flow of 7 steps" in said, "learned from" in said) == (0, True, False)


@pytest.mark.parametrize("position", ["learnable", "fourier_features"])
@pytest.mark.parametrize("around", [False, True])
def test_with_a_position_it_draws_the_same_and_can_tell_directions(position, around):
    small = grown(flow(), (16, 128)) if around else flow()
    wider = widened(small, position=position).generator
    shape = (1, *small.generator.noise_shape)
    t, x = torch.tensor(0.5), torch.randn(shape)
    with torch.no_grad():
        assert torch.allclose(wider.velocity(t, x), small.generator.velocity(t, x), atol=1e-5)
    optimiser = torch.optim.SGD(wider.parameters(), lr=0.5)
    wider.train()
    for _ in range(2):
        optimiser.zero_grad()
        (wider.velocity(t, x) - torch.linspace(-1, 1, shape[-1])).square().mean().backward()
        optimiser.step()
    wider.eval()
    turn = shape[-1] // 2
    with torch.no_grad():
        turned = small.generator.velocity(t, x.roll(turn, -1)).roll(-turn, -1)
        assert torch.allclose(turned, small.generator.velocity(t, x), atol=1e-4)
        assert (wider.velocity(t, x.roll(turn, -1)).roll(-turn, -1) - wider.velocity(t, x)).abs().max() > 1e-3
    with pytest.raises(InputError, match="holds no hdit without a position"):
        widened(Checkpoint(wider, widened(small, position=position).config), position="polar")
