"""Larger networks out of trained ones."""

import runpy
from pathlib import Path

import pytest
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.maps import jump
from r2flow.generators import FlowMap, build_generator
from r2flow.model.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, weights_hash
from tests.conftest import CONFIG

grown = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "street" / "growing.py"))["grown"]
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


def test_a_grown_map_learns_on_as_a_map(r2flow, tmp_path):
    small = flow(generator={"name": "flow_map"})
    out, run = tmp_path / "larger.safetensors", tmp_path / "run"
    save_checkpoint(grown(small, (16, 128)), out)
    pairs = ("data.pairs.num=4", "data.pairs.sampler.steps=2", "data.batch_size=2")
    quick = ("trainer=cpu", "trainer.max_steps=2", "samples.num=0", "callbacks.pictures=null")
    r2flow.said("train", "experiment=flow_map", f"stage.init={out}", f"run_dir={run}", *pairs, *quick)
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
    with pytest.raises(InputError, match=r"images of 8x64 cannot grow to .*"):
        grown(flow(), shape)


def test_other_generators_do_not_grow():
    with pytest.raises(InputError, match="holds a TransferFlow; only a flow of whole scans can grow"):
        grown(flow(generator={"name": "transfer_flow"}, backbone={"name": "local"}), (16, 128))


def test_a_diffusion_has_no_time_for_a_pyramid():
    large = grown(flow(), (16, 128))
    with pytest.raises(InputError, match="a pyramid needs the time of straight lines"):
        build_generator({**large.config, "generator": {"name": "diffusion"}})
