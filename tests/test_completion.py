"""Networks with random weights: what is claimed here holds whatever they have learned."""

import math

import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.generators import Generator
from r2flow.lidar.known import Ray, ray_states
from r2flow.model import completion
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.completion import Completed, complete, completing
from r2flow.samplers import build_sampler
from tests import test_sampling
from tests.conftest import CONFIG
from tests.test_sampling import scans

SHAPE = 8, 64


def network(name: str = "transfer_flow", reflectance: bool = True) -> Checkpoint:
    backbone = {**CONFIG["backbone"], "position": "none", "ring": True}
    if name == "transfer_flow":
        backbone = {"name": "local", "channels": 8, "dilations": [1, 2]}
    made = test_sampling.network(reflectance, generator={"name": name}, backbone=backbone)
    made.generator.sampler = build_sampler("euler", steps=3)
    return made


def halved(images: torch.Tensor) -> torch.Tensor:
    return ray_states(images, torch.arange(SHAPE[0])[:, None].expand(SHAPE) % 2 == 0)


def test_a_scan_without_a_return_is_one_of_a_batch_without_reflectance():
    images = scans()[:, :1]
    images[0] = 0
    state = halved(images)
    state[0] = int(Ray.EMPTY)
    found = network().complete(images, state, steps=2)
    assert found.shape == (2, 1, 2, *SHAPE)
    assert not found[0].any()


def test_a_scan_of_which_nothing_is_known_is_the_sample_of_its_number():
    checkpoint = network("rectified_flow")
    nothing = torch.zeros(3, 2, *SHAPE)
    state = torch.zeros(3, *SHAPE, dtype=torch.uint8)
    found = checkpoint.complete(nothing, state, num=2, seed=5)
    assert torch.equal(found[:, 0], checkpoint.sample(3, seed=5))
    assert not torch.equal(found[0, 1], found[1, 0])  # no two answers have one noise
    (later,) = complete(checkpoint, nothing[:1], state[:1], num=1, seed=5, first=2)
    assert torch.equal(later.images, found[2, :1])


def test_a_scan_of_which_nothing_is_known_is_drawn_in_the_precision_that_was_asked_for():
    flow = network("rectified_flow")
    nothing, coarse = torch.zeros(1, 2, *SHAPE), flow.sample(1, precision="bf16-mixed")
    assert not torch.equal(coarse, flow.sample(1))
    assert torch.equal(flow.complete(nothing, precision="bf16-mixed")[:, 0], coarse)


def test_scans_that_are_known_in_part_wholly_and_not_at_all_go_together():
    images = scans(3)
    state = halved(images)
    state[1] = ray_states(images)[1]
    state[2] = Ray.UNKNOWN
    checkpoint = network("rectified_flow")
    found = list(
        complete(
            checkpoint,
            images,
            state,
            num=2,
            batch_size=4,
            sampler=build_sampler("replace", steps=2),
        )
    )
    assert [one.evaluations.tolist() for one in found] == [[2, 2], [0, 0], [3, 3]]
    assert torch.equal(found[1].images, images[1].expand(2, -1, -1, -1))
    assert found[1].converged.all()
    assert not found[1].spread[0].any()
    for i, one in enumerate(found):
        (alone,) = complete(
            checkpoint,
            images[i : i + 1],
            state[i : i + 1],
            num=2,
            first=i,
            sampler=build_sampler("replace", steps=2),
        )
        torch.testing.assert_close(one.images, alone.images, rtol=1e-4, atol=1e-4)


def test_reflectance_that_was_not_given_is_completed():
    images = scans()
    found = network().complete(images[:, :1], ray_states(images))[:, 0]
    assert torch.equal(found[:, 0], images[:, 0])
    returned = images[:, 0] > 0
    assert not found[:, 1][~returned].any()
    assert found[:, 1][returned].std() > 0


def test_without_states_a_ray_without_a_return_is_not_measured():
    images = scans()
    state = torch.where(images[:, 0] > 0, int(Ray.RETURN), int(Ray.UNKNOWN))
    assert torch.equal(network().complete(images), network().complete(images, state))


def test_spread_is_over_the_answers_with_a_return():
    images = torch.tensor([[3.0, 5.0, 0.0], [5.0, 0.0, 0.0], [7.0, 0.0, 0.0]]).view(3, 1, 1, 3)
    deviation, share = Completed(images, 0, torch.zeros(3), torch.ones(3) > 0, 0.0).spread
    assert deviation.tolist() == [[2.0, 0.0, 0.0]]  # of 3, 5, 7: sqrt((4 + 0 + 4) / 2)
    torch.testing.assert_close(share, torch.tensor([[1, 1 / 3, 0]]))


def test_each_answer_has_errors_of_its_added_points():
    images = scans(1)
    state = halved(images)
    flow = network()
    for how in ({"sampler": "jump", "steps": 1}, {"sampler": "transport"}):
        (found,) = complete(flow, images, state, num=3, batch_size=2, **how)
        likely, nearly_sure = found.error(0.68, 0.95)
        added = (found.images[:, 0] > 0) & ~found.measured
        assert torch.equal(likely > 0, added)
        assert (nearly_sure >= likely).all()
        assert torch.equal(
            found.p_return[:, found.measured] > 0.5, found.images[:, 0][:, found.measured] > 0
        )
    (whole,) = complete(flow, images, ray_states(images))
    assert not whole.error(0.68).any()
    assert torch.equal(whole.p_return, (images[:, 0] > 0).float())
    (other,) = complete(network("rectified_flow"), images, state)
    assert other.error(0.68)[0].isnan().any()
    assert other.p_return[:, ~other.measured].isnan().all()


@pytest.mark.parametrize(
    ("sensor", "size", "other"), [("hdl64e", "32x256", False), ("vlp16", "16x256", True)]
)
def test_coarser_images_of_the_own_sensor_are_not_of_another(r2flow, tmp_path, sensor, size, other):
    assert r2flow(
        "simulate",
        "--num",
        1,
        "--sensor",
        sensor,
        "--size",
        size,
        "--format",
        "npy",
        "--out",
        tmp_path,
    ).said
    found, (scan,), _ = load_checkpoint("densify").open_partial([str(tmp_path)])
    rows, columns = scan.read().state.nonzero()
    assert found.generator.foreign == other
    assert other or (set(rows % 2), set(columns % 4)) == ({1}, {2})  # rays on edges of pixels


def test_a_model_of_another_sensor_is_not_saved_as_that_of_training(tmp_path):
    with pytest.raises(InputError, match="save the model before `through`"):
        network().through("vlp16").save(tmp_path / "moved.safetensors")


@pytest.mark.parametrize("fast", [True, False])
def test_a_transfer_flow_computes_in_bfloat16_on_processors_that_have_it(fast, monkeypatch):
    monkeypatch.setattr(completion, "multiplies_bfloat16", lambda: fast)
    expected = "bf16-mixed" if fast else "32-true"
    assert completion.usual_precision(network().generator) == expected
    flow = network("rectified_flow").generator
    assert completion.usual_precision(flow) == "32-true"
    assert completion.usual_precision(flow, measured=True) == expected


def test_a_generator_that_cannot_complete_is_refused():
    with pytest.raises(
        InputError, match="a Generator cannot complete a scan: that needs a flow of range images"
    ):
        completing(Generator(network().generator.space, (4,)))


def test_a_flow_without_a_condition_says_what_completes_with_it():
    for model, name, words in (
        ("rectified_flow", "euler", "repaint"),
        ("transfer_flow", "rk4", "rk4 needs v at"),
    ):
        with pytest.raises(InputError, match=words):
            completing(network(model).generator, name)
    assert completing(network().generator, "euler").name == "euler"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"images": torch.zeros(1, 2, 8, 32)}, r"must be \(B, 1 to 2, 8, 64\)"),
        ({"images": torch.full((1, 2, 8, 64), math.nan)}, "nan m"),
        ({"images": torch.full((1, 2, 8, 64), 0.5)}, "a range of 0.5 m"),
        ({"images": torch.full((1, 2, 8, 64), 3.0)}, "reflectance goes up to 3, not 1; divide"),
        ({"state": torch.zeros(1, 8, 32)}, "the states of the rays"),
        ({"batch_size": 0}, "a batch of at least 1; found 1, 0"),
        ({"state": torch.full((1, 8, 64), 9)}, "Ray.UNKNOWN"),
        ({"state": torch.full((1, 8, 64), int(Ray.RETURN))}, "Ray.UNKNOWN"),
    ],
)
def test_what_fits_nothing_is_refused(changed, message):
    given = {
        "images": torch.zeros(1, 2, *SHAPE),
        "state": torch.zeros(1, *SHAPE, dtype=torch.uint8),
        **changed,
    }
    with pytest.raises(InputError, match=message):
        list(complete(network(), **given))
