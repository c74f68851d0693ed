"""A flow of larger images around a trained one."""

import pytest
import torch
from torch import Tensor

from r2flow.checkpoints import Checkpoint, load_checkpoint, weights_hash
from r2flow.errors import InputError
from r2flow.generators import RectifiedFlow, Sampler, build_generator
from r2flow.growing import grown
from tests.test_checkpoints import CONFIG, saved  # noqa: F401  a fixture
from tests.test_cli import r2flow  # noqa: F401  a fixture

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


def test_of_a_flow_map_a_flow_grows():
    small = flow(generator={"name": "flow_map"})
    large = grown(small, (16, 128))
    assert type(large.generator) is RectifiedFlow
    assert not large.generator.backbone.second_time
    assert large.config["parent"]["weights"] == weights_hash(small)


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
    code, _, said = r2flow("grow", path, tmp_path / "larger.ckpt", "--size", "16x128")
    assert (code, "give a .safetensors" in said) == (2, True)
