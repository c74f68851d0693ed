"""The errors of a flow's sampler: measured against paths that are known, kept, and held for every scan."""

import math
from dataclasses import replace

import pytest
import torch

from r2flow.accuracy import GRIDS, STEPS, calibrate, evaluations_of_calibration, sampler_within
from r2flow.errors import InputError
from r2flow.flow.problems import Gaussian, Mixed, Straight, TwoModes
from r2flow.flow.solvers import solve
from r2flow.generators import Budget, Field, Sampler, build_generator, levels
from r2flow.model.checkpoint import Checkpoint, keep_sampler, load_checkpoint, save_checkpoint
from r2flow.noise import Draws
from tests.test_checkpoints import CONFIG, saved  # noqa: F401  a fixture
from tests.test_sampling import GaussianFlow, M, S, flow


def gaussian_end(x_0):
    return M + S * x_0


def test_a_calibration_measures_the_errors_of_its_sampler():
    calls: list[int] = []
    checkpoint = calibrate(flow(), steps=8, num=2, progress=lambda: calls.append(1))
    sampler = checkpoint.generator.sampler
    assert len(calls) <= evaluations_of_calibration(8)
    assert [budget.steps for budget in checkpoint.accuracy] == list(STEPS)
    x_0 = Draws(0, range(2), "validation").start(checkpoint.generator.noise_shape)
    exact = gaussian_end(x_0.double())

    def error(how):
        return (checkpoint.generator.solve(x_0, sampler=how).x - exact).square().flatten(1).mean(1).sqrt()

    for budget in checkpoint.accuracy[:5]:
        expected = error(replace(sampler, steps=budget.steps))
        torch.testing.assert_close(torch.tensor(budget.errors, dtype=torch.float64), expected, rtol=0.02, atol=1e-6)
    ends = {grid: checkpoint.generator.solve(x_0, sampler=Sampler("adams3", 8, grid=grid)).x for grid in GRIDS}
    typical = {grid: (end - exact).abs().median().item() for grid, end in ends.items()}
    assert typical[sampler.grid] <= 1.02 * min(typical.values())


class FewStiffAtTheStart(GaussianFlow):
    """v of a narrow Gaussian, which needs short steps near t = 1, but for one column that falls steeply at t = 0."""

    def forward(self, t, x):
        t = t.view(-1, 1, 1, 1) if t.ndim else t
        v = (t * 0.02**2 - (1 - t)) / ((1 - t) ** 2 + (t * 0.02) ** 2) * x
        return torch.cat([-40 * (-40 * t).exp() * (1 + 0 * x[..., :1]), v[..., 1:]], -1)


def test_the_time_grid_is_that_of_most_rays_and_not_of_a_few():
    checkpoint = calibrate(flow(FewStiffAtTheStart()), steps=16, num=2)
    assert checkpoint.generator.sampler.grid.startswith("power:")
    x_0 = Draws(0, range(2), "validation").start(checkpoint.generator.noise_shape)
    exact = checkpoint.generator.solve(x_0.double(), sampler=Sampler("dopri5", tolerance=1e-8)).x

    def mean_square(grid):
        return float(
            (checkpoint.generator.solve(x_0, sampler=Sampler("adams3", 16, grid=grid)).x - exact).square().mean()
        )

    # The few have the largest errors: by the mean square, the other way round would be best.
    assert min(GRIDS, key=mean_square).startswith("power-start:")


def test_the_correction_is_the_error_of_the_predictor_alone():
    # v(t) = 1 + 2 t: the trapezoidal rule is exact, and only the first step, which is Euler's, is corrected: by h^2.
    x_0 = torch.zeros(2, 3, dtype=torch.float64)
    found = solve(lambda t, x: 1 + 2 * t + 0 * x, x_0, method="adams2", steps=4)
    assert found.correction.tolist() == pytest.approx([1 / 16] * 2)
    torch.testing.assert_close(found.x, torch.full_like(x_0, 2.0))
    assert solve(lambda t, x: -x, x_0, method="ab2", steps=4).correction is None


def test_every_scan_gets_the_steps_that_it_needs_and_no_other_scan_s_matter():
    problems = [Straight(), TwoModes(), Straight(), Gaussian(), TwoModes(), Straight()]
    batch = Mixed(problems)
    x_0 = torch.randn(6, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    how = Sampler("adams3", grid="power:1.75", levels=(6, 16, 64), limits=(0.02, 0.02))
    found = Field(batch, (64,)).solve(x_0, sampler=how)
    assert found.evaluations[0] == found.evaluations[2] == found.evaluations[5] == 6
    assert set(found.evaluations[[1, 4]].tolist()) <= {22, 86}
    for scene, problem in enumerate(problems):
        alone = Field(problem, (64,)).solve(x_0[scene : scene + 1], sampler=how)
        assert torch.equal(alone.x[0], found.x[scene])
        assert alone.evaluations[0] == found.evaluations[scene]
        # the result is that of the last number of steps that was tried
        last = {6: 6, 22: 16, 86: 64}[int(found.evaluations[scene])]
        plain = Field(problem, (64,)).solve(
            x_0[scene : scene + 1], sampler=replace(how, levels=(), limits=(), steps=last)
        )
        assert torch.equal(plain.x, alone.x)
        assert torch.equal(plain.correction, alone.correction)


EASY = Budget(8, (0.01, 0.02), (0.1, 0.4), (0.05, 0.06))
MIDDLE = Budget(16, (0.001, 0.004), (0.01, 0.05), (0.02, 0.03))
FINE = Budget(32, (0.0001, 0.0003), (0.001, 0.004), (0.005, 0.006))


@pytest.mark.parametrize(("error", "metres", "expected"), [
    # Half the error is aimed at. All scans arrive at 8; one that is unlike them, with a correction above 3 = .06/.02
    # times that, goes on.
    (0.04, False, ((8, 16, 32), (0.06, 0.02 * 7.5))),
    # At 8 one of two arrives, so that 8 + 8 + 16 evaluations are as many as 16 + 16: the fewer steps are tried first.
    (0.0398, False, ((8, 16, 32), (0.0199 * 3, 0.0199 * 7.5))),
    (0.1, True, ((16, 32), (0.05 * 0.6,))),
    (0.0006, False, ((32,), ())),
])  # fmt: skip
def test_the_first_number_of_steps_is_the_cheapest_one(error, metres, expected):
    steps, limits = levels([EASY, MIDDLE, FINE], error, metres)
    assert steps == expected[0]
    assert limits == pytest.approx(expected[1])


def test_an_error_out_of_reach_is_refused():
    with pytest.raises(InputError, match="less than this flow's sampler reaches in 32 steps, 0.0006"):
        levels([EASY, MIDDLE, FINE], 0.0005)
    with pytest.raises(InputError, match="an error of 0.007 m is less"):
        levels([EASY, MIDDLE, FINE], 0.007, metres=True)
    with pytest.raises(InputError, match="are not known yet; measure them: r2flow calibrate"):
        sampler_within(flow(), "0.05m")
    config = {**CONFIG, "generator": {"name": "flow_map"}}
    learned = Checkpoint(build_generator(config).eval(), config)
    for ask in (lambda: sampler_within(learned, "0.05m"), lambda: calibrate(learned)):
        with pytest.raises(InputError, match="holds a flow map that has learned its steps: .* give --steps"):
            ask()
    known = replace(flow(), accuracy=(EASY, MIDDLE, FINE))
    for text in ("", "m", "5cm", "-1m", "nan", "inf"):
        with pytest.raises(InputError, match="must be metres of range, as 0.05m, or a number in model space"):
            sampler_within(known, text)
    for text, asked in (("0.05m", (0.05, True)), ("0.02", (0.02, False))):
        sampler = sampler_within(known, text)
        assert (sampler.levels, sampler.limits) == levels([EASY, MIDDLE, FINE], *asked)
    known.generator.sampler = known.generator.sampler.changed(precision="bf16-mixed")
    assert sampler_within(known, "0.05m").precision == "32-true"  # in which errors are measured


def test_only_predictor_correctors_are_calibrated():
    for method in ("euler", "ab2", "dopri5", "torchdiffeq:rk4"):
        with pytest.raises(InputError, match="only predictor-correctors are calibrated: adams2, adams3, adams4; found"):
            calibrate(flow(), method=method)
    with pytest.raises(InputError, match="dopri5 does not solve this flow"):
        calibrate(flow(GaussianFlow(math.nan)), num=1)


@pytest.mark.parametrize("ending", [".ckpt", ".safetensors"])
def test_a_calibrated_sampler_stays_with_its_file(saved, tmp_path, ending):  # noqa: F811
    path, original = saved[0], load_checkpoint(saved[0])
    if ending == ".safetensors":
        path = tmp_path / "model.safetensors"
        save_checkpoint(original, path)
    loaded = load_checkpoint(path)
    loaded.generator.sampler = Sampler("adams2", 12, grid="power:2.5")
    keep_sampler(replace(loaded, accuracy=(EASY, FINE)))
    again = load_checkpoint(path)
    assert again.generator.sampler == loaded.generator.sampler
    assert again.accuracy == (EASY, FINE)
    assert (again.step, again.config) == (original.step, original.config)
    for name, value in again.generator.state_dict().items():
        assert torch.equal(value, original.generator.state_dict()[name])
    with pytest.raises(InputError, match=r"has no place for a sampler"):
        keep_sampler(replace(loaded, format="published"))


def test_samplers_of_older_versions_are_read():
    # Version 0.1.0 called t = 1 - (1 - u)^2 quadratic, and knew no levels.
    old = {"method": "ab2", "steps": 4, "tolerance": 1e-5, "grid": "quadratic", "fixed": False}
    assert Sampler.of(old) == Sampler("ab2", 4, grid="power:2")
    own = Sampler("adams3", 8, levels=(8, 16), limits=(0.1,))
    assert Sampler.of(own.asdict()) == own
    assert own.changed(steps=4).levels == own.changed(method="euler").levels == ()


def test_the_last_step_of_a_finish_is_euler_s_and_counted():
    # x' = 2 t: exact up to 1 - f, then f 2 (1 - f), which lacks f^2.
    one, f = Field(lambda t, x: 2 * t + 0 * x, (3,)), 1 / 8
    how = Sampler("adams2", 5, finish=f)
    made = one.generate(torch.zeros(2, 3, dtype=torch.float64), sampler=how)
    torch.testing.assert_close(made.x, torch.full_like(made.x, 1 - f**2))
    assert made.evaluations.tolist() == [5, 5]
    assert one.generate(torch.zeros(2, 3), sampler=replace(how, steps=1)).evaluations.tolist() == [1, 1]
    assert one.solve(torch.zeros(1, 3), sampler=how).evaluations.tolist() == [5]
    assert how.changed(method="euler").finish == how.changed(grid=(0.0, 0.5, 1.0), steps=2).finish == 0
    assert how.changed(steps=9).finish == f
    with pytest.raises(InputError, match="finish must be a finite number in"):
        Sampler.of({"finish": 1.0})
