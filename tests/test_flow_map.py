"""The generator `FlowMap`: jumps of a network of two times, and the stage that learns them."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.base.noise import Draws, standard_normal
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.loader import FlowDataset
from r2flow.data.options import PairOptions
from r2flow.data.pairs import PairDataset, PairStore, make_pairs
from r2flow.flow.maps import OBJECTIVES
from r2flow.flow.problems import Gaussian
from r2flow.generators import FlowMap, RectifiedFlow, build_generator
from r2flow.model.config import ModelConfig
from r2flow.model.lineage import Parent, model_options
from r2flow.samplers import build_sampler
from r2flow.stages import STAGES
from r2flow.stages.flow_map import LearnFlowMap
from r2flow.stages.rectify import Reflow
from tests.fields import CONFIG, Field
from tests.test_sampling import network


@pytest.fixture(scope="module")
def parent() -> RectifiedFlow:
    return network(**CONFIG).generator


def flow_map() -> FlowMap:
    return build_generator({**CONFIG, "generator": {"name": "flow_map"}}).eval()


@pytest.fixture
def grown(parent) -> FlowMap:
    found = flow_map()
    found.start_from(parent)
    return found


class Exact(FlowMap):
    """The map of a Gaussian problem: x_s = s m + sigma_s / sigma_t (x_t - t m)."""

    problem = Gaussian()

    def mean_velocity(self, t, x, s):
        scale = [((1 - time) ** 2 + (time * self.problem.std) ** 2).sqrt() for time in (t, s)]
        moved = s * self.problem.mean + scale[1] / scale[0] * (x - t * self.problem.mean) - x
        return moved / (s - t)

    def velocity(self, t, x, condition=None):
        return self.problem(t, x)


@pytest.fixture
def exact() -> Exact:
    found = flow_map()
    found.__class__ = Exact
    return found  # type: ignore[return-value]


def test_before_it_has_learned_jumps_are_its_parent_s_euler_steps(grown, parent):
    x_0 = Draws(0, range(2)).start(grown.noise_shape)
    for name, steps, grid in (
        ("jump", 1, "uniform"),
        ("jump", 3, "uniform"),
        ("jump", 3, "power:2"),
    ):
        jumped = grown(x_0, sampler=build_sampler(name, steps=steps, grid=grid))
        walked = parent(x_0, sampler=build_sampler("euler", steps=steps, grid=grid))
        # s - t is rounded otherwise
        torch.testing.assert_close(jumped.x, walked.x, rtol=0, atol=1e-5)
        assert jumped.evaluations.tolist() == [steps, steps]
    t = torch.tensor([0.3, 0.6])
    assert torch.equal(grown.velocity(t, x_0), parent.velocity(t, x_0))


def test_a_flow_that_goes_on_from_a_map_has_its_velocity():
    learned = network(**CONFIG, generator={"name": "flow_map"}).generator
    x, t = torch.randn(3, 2, 8, 32), torch.tensor([0.0, 0.3, 1.0])
    plain = build_generator(CONFIG).eval()
    plain.start_from(learned)
    assert torch.equal(plain.velocity(t, x), learned.velocity(t, x))
    apart = learned.mean_velocity(t, x, torch.ones(3)) - plain.velocity(t, x)
    assert apart[:2].abs().max().item() > 1e-4


@pytest.mark.parametrize(("stage", "made"), [("rectify", "rectified_flow"), ("reflow", "rectified_flow"),
                                             ("distill", "rectified_flow"), ("flow_map", "flow_map"),
                                             ("transfer", "transfer_flow")])  # fmt: skip
def test_what_a_stage_makes_of_a_map(stage, made):
    of_map = Parent(ModelConfig({**CONFIG, "generator": {"name": "flow_map"}}), Path("x"))
    assert model_options({}, of_map, STAGES[stage].generator_name)["generator"] == {"name": made}


@pytest.mark.parametrize(
    ("steps", "grid"), [(1, "uniform"), (4, "power:2"), (3, (0.0, 0.2, 0.7, 1.0))]
)
def test_jumps_of_an_exact_map_end_where_the_flow_does(exact, steps, grid):
    x_0 = Draws(0, range(3)).start(exact.noise_shape)
    found = exact(x_0, sampler=build_sampler("jump", steps=steps, grid=grid))
    torch.testing.assert_close(
        found.x.double(), Exact.problem.solution(x_0, 1.0), rtol=0, atol=1e-5
    )
    assert found.converged.all()


def test_refined_samples_follow_the_path_then_renoise(exact, monkeypatch):
    draws = Draws(5, range(2))
    x_0 = draws.start(exact.noise_shape)
    found = exact(x_0, sampler=build_sampler("refine", steps=100, jumps=2), draws=draws)
    s = 1 - 0.1 / 6.4**0.5  # the middle of 0.1 to 1 / 64 in the logarithm
    between = s * (0.7 + 0.25 * x_0) + (1 - s) * draws.step(exact.noise_shape, 1)
    expected = 0.7 + 0.25 / ((1 - s) ** 2 + (0.25 * s) ** 2) ** 0.5 * (between - 0.7 * s)
    torch.testing.assert_close(found.x, expected, rtol=0, atol=1e-4)
    assert found.evaluations.tolist() == [100, 100]
    few = [
        exact(x_0, sampler=build_sampler(name, steps=6), draws=draws).x
        for name in ("refine", "renoise")
    ]
    assert torch.equal(*few)
    grid = [0, 0.3, 0.6, 0.8, 0.9, 1]
    assert build_sampler("refine", jumps=2, grid=grid).times().tolist() == grid
    with torch.device("meta"):  # a default device of the user's
        assert {draws.step((2,), 1).device.type, build_sampler("refine").times().device.type} == {
            "cpu"
        }
    end = type(
        "End",
        (),
        {"x": torch.zeros(2, device="meta"), "converged": torch.ones(2, dtype=torch.bool)},
    )
    # solvers note convergence on the CPU
    monkeypatch.setattr("r2flow.samplers.maps.solve", lambda *_, **__: end)
    assert (
        build_sampler("refine")(exact, end.x, None, lambda j: end.x, lambda: None).converged.device
        == end.x.device
    )


OWN = build_sampler("adams3", steps=16, grid="power:1.75")


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({"steps": 15}, build_sampler("renoise", steps=15)),
        ({"steps": 2, "grid": "power:3"}, build_sampler("renoise", steps=2, grid="power:3")),
        ({"steps": 16}, OWN),
        ({"steps": 32}, build_sampler("adams3", steps=32, grid="power:1.75")),
        ({"steps": 4, "name": "adams3"}, build_sampler("adams3", steps=4, grid="power:1.75")),
        ({"steps": 4, "name": "euler"}, build_sampler("euler", steps=4)),
        ({"name": "renoise"}, build_sampler("renoise")),
        ({}, OWN),
    ],
)
def test_fewer_steps_alone_go_over_to_the_sampler_for_few(grown, asked, expected):
    grown.run_by(OWN, build_sampler("renoise"))
    assert grown.choose(**asked) == expected


def test_the_own_grid_of_renoise_is_late():
    log = (1.625, 2.875, 4.125, 5.375)  # equal parts of 1 to 6
    expected = torch.tensor([0, *(1 - 2**-part for part in log), 1]).double()
    torch.testing.assert_close(build_sampler("renoise", steps=5).times(), expected)


def test_a_run_notes_the_sampler_for_few():
    assert stage(few={"name": "renoise"}).generator.few == build_sampler("renoise")
    with pytest.raises(InputError, match="renoize"):
        stage(few={"name": "renoize"})


def data_of(name: str, **options) -> ScanDataModule:
    return ScanDataModule(name, CONFIG["sensor"], batch_size=4, **options)


def stage(data: str = "pairs", **options) -> LearnFlowMap:
    """The stage in a trainer at step 30 of 60."""
    found = LearnFlowMap(**{"generator": flow_map(), **options})
    found._trainer = SimpleNamespace(
        datamodule=data_of(data),
        callbacks=[],
        accumulate_grad_batches=1,
        global_step=30,
        estimated_stepping_batches=60,
    )
    found.setup("fit")
    return found


def batch_of(**further) -> dict[str, torch.Tensor]:
    draws = torch.Generator().manual_seed(0)
    x_0, x_1 = torch.randn(2, 4, 2, 8, 32, generator=draws).unbind(0)
    return {
        "x_0": x_0,
        "x_1": x_1,
        "u": torch.rand(4, generator=draws),
        "k": torch.arange(4),
        **further,
    }


def test_renoised_pairs_are_one_jump_and_what_the_map_makes_of_it_later(exact, tmp_path: Path):
    sampler = {"name": "renoise", "steps": 3, "grid": "power:5"}
    options = PairOptions(sampler=sampler, num=6, batch_size=2, seed=3, parent="a")
    store = PairStore(tmp_path, options, exact.space.shape)
    make_pairs(store, exact)
    mean, std = exact.problem.mean, exact.problem.std
    pairs = PairDataset(store, store.usable(), 0, "training")
    for index in range(6):
        x_0, x_1 = pairs[0, index]["x_0"], pairs[0, index]["x_1"]
        assert torch.equal(x_0, standard_normal(exact.noise_shape, 3, "pairs", index))
        expected = mean + std * x_0
        # where later steps on power:5 begin
        for j, t in ((1, 1 - (2 / 3) ** 5), (2, 1 - (1 / 3) ** 5)):
            x_t = t * expected + (1 - t) * standard_normal(exact.noise_shape, 3, "pairs", index, j)
            expected = mean + std * (x_t - t * mean) / ((1 - t) ** 2 + (t * std) ** 2) ** 0.5
        torch.testing.assert_close(x_1, expected, rtol=2**-11, atol=2e-5)
    other = PairOptions(num=6, sampler={"name": "sde"}, parent="a")
    with pytest.raises(InputError, match="sde"):
        make_pairs(PairStore(tmp_path / "other", other, exact.space.shape), exact)


@pytest.mark.parametrize("objective", list(OBJECTIVES))
def test_a_flow_map_learns_a_map_that_it_can_know(objective, monkeypatch):
    """Pairs x_1 = 0.5 x_0, whose map is u = -0.5 x / (1 - t / 2) at every s: the loss falls in a
    few steps.
    """
    torch.manual_seed(0)
    monkeypatch.setattr(LearnFlowMap, "log", lambda *_, **__: None)
    learned = stage(objective=objective)
    optimizer = torch.optim.AdamW(learned.parameters(), 1e-2)
    learned.train()
    losses = []
    for step in range(16):
        batch = batch_of(k=torch.arange(4) + 4 * step)
        batch["x_1"] = 0.5 * batch["x_0"]
        loss = learned.training_step(batch, step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-3:]) < 0.6 * sum(losses[:3])


@pytest.mark.parametrize(("name", "regressed"), [("pairs", True), ("simulated", False)])
def test_the_jump_from_noise_to_scan_is_regressed_on_pairs_alone(monkeypatch, name, regressed):
    """Of scans drawn independently of the noise it would become the mean of all scans."""
    learned = stage(name)
    learned.jumps = lambda u: (torch.zeros(4), torch.ones(4))  # type: ignore[assignment]
    learned.trainer.global_step = 60
    aims: list[torch.Tensor] = []
    learned.loss = lambda found, target: aims.append(target) or found.flatten(1).mean(1)  # type: ignore[assignment]
    batch = batch_of()
    learned.train().regression_loss(batch, batch["u"])
    assert torch.allclose(aims[0], batch["x_1"] - batch["x_0"]) is regressed


def test_with_scans_beside_the_pairs_velocities_are_those_of_the_scans_and_jumps_those_of_the_pairs(
    monkeypatch,
):
    noise, scan = torch.randn(2, 4, 2, 8, 32, generator=torch.Generator().manual_seed(1)).unbind(0)
    batch = batch_of(noise=noise, scan=scan)
    learned = stage(objective="straight").eval()
    t, s = torch.tensor([0.0, 0.3, 0.5, 1.0]), torch.tensor([1.0, 0.3, 0.75, 1.0])
    learned.jumps = lambda u: (t, s)  # type: ignore[assignment]
    asked, aims = list[torch.Tensor](), list[torch.Tensor]()
    monkeypatch.setattr(
        learned.generator, "mean_velocity", lambda t, x, s: asked.append(x) or torch.zeros_like(x)
    )
    learned.loss = lambda found, target: aims.append(target) or found.flatten(1).mean(1)  # type: ignore[assignment]
    learned.regression_loss(batch, batch["u"])
    on_scans = (1 - t.view(4, 1, 1, 1)) * noise + t.view(4, 1, 1, 1) * scan
    on_pairs = (1 - t.view(4, 1, 1, 1)) * batch["x_0"] + t.view(4, 1, 1, 1) * batch["x_1"]
    for row, (expected, slope) in enumerate(
        [(on_pairs, batch["x_1"] - batch["x_0"]), (on_scans, scan - noise)] * 2
    ):
        torch.testing.assert_close(asked[0][row], expected[row])
        torch.testing.assert_close(aims[0][row], slope[row])


def test_scans_beside_pairs_are_for_straight_lines(parent):
    scans = {"name": "simulated", "scenes": 4}
    data = data_of("pairs", scans=scans)
    stage(objective="straight").check_data(data)
    with pytest.raises(
        InputError, match=r"leave data\.scans out, or give stage\.objective=straight"
    ):
        stage().check_data(data)
    with pytest.raises(
        InputError, match=r"stage=reflow learns from pairs alone: leave data\.scans out"
    ):
        Reflow(generator=parent).check_data(data)
    with pytest.raises(InputError, match=r"data\.scans needs the name of a data set"):
        data_of("pairs", scans={"scenes": 4})


def test_a_batch_of_pairs_with_scans_beside_is_a_function_of_its_number(tmp_path: Path):
    flow = flow_map()
    keys = {
        "name": "pairs",
        "root": str(tmp_path),
        "batch_size": 4,
        "scans": {"name": "simulated", "scenes": 5},
    }
    pairs = {"sampler": {"name": "adams3", "steps": 1}, "num": 10, "batch_size": 2, "parent": "a"}
    data = ScanDataModule(
        sensor=flow.space.sensor, encoding=flow.space.encoding, seed=3, pairs=pairs, **keys
    )
    make_pairs(data.pair_store, Field(lambda t, x: x, flow.noise_shape))
    data.setup()
    data._ready()
    assert data.fingerprint().startswith("10 pairs, ")
    assert "; 5 of 5 scans, " in data.fingerprint()
    held = [
        scan["x_1"]
        for scan in (FlowDataset(data.scans, data.format, 3, "beside")[0, i] for i in range(5))
    ]
    dataset = data._dataset(data.training_source, "training")
    once, again = ([dataset[k, k % 9] for k in range(10)] for _ in range(2))
    for first, second in zip(once, again, strict=True):
        assert all(torch.equal(first[key], second[key]) for key in first)
        assert not torch.equal(first["noise"], first["x_0"])
    which = [
        next(i for i, scan in enumerate(held) if torch.equal(scan, item["scan"])) for item in once
    ]
    # every scan once, then every scan again
    assert sorted(which[:5]) == sorted(which[5:]) == [0, 1, 2, 3, 4]
    assert "scan" not in data._dataset(data.validation_source, "validation")[0, 0]


def test_a_stage_of_jumps_says_what_it_lacks(parent):
    with pytest.raises(InputError, match="no option 'time'"):
        stage(time={"name": "uniform"})
    with pytest.raises(InputError, match="'step'"):
        stage(jumps={"step": [1]})
    with pytest.raises(InputError, match="learns a FlowMap"):
        stage(generator=parent)
    assert stage("simulated").on_pairs is False


def test_a_map_is_drawn_on_the_grid_that_it_learned():
    found = stage(jumps={"grid": "power:3"}).generator
    assert found.sampler == build_sampler("jump", steps=4, grid="power:3")
    assert found.choose(steps=2) == build_sampler("jump", steps=2, grid="power:3")
