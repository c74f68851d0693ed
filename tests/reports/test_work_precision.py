import csv
import json
import math

import numpy as np
import pytest
import torch

from r2flow.errors import InputError
from r2flow.flow.problems import PROBLEMS
from r2flow.generators import Field, Sampler
from r2flow.inversion import metres_apart
from r2flow.reports import work_precision
from r2flow.reports.work_precision import (
    Configuration,
    Subject,
    best_within,
    configurations,
    measure,
    pareto,
    problem_subjects,
    reference,
    runs,
)
from r2flow.reports.work_precision_page import (
    best_table,
    problems_text,
    recommendation,
    steadiest,
    work_precision_page,
)
from tests.test_checkpoints import saved  # noqa: F401  a fixture
from tests.test_cli import r2flow  # noqa: F401  a fixture


def test_steps_fit_the_budgets():
    chosen = configurations(["euler", "rk4", "dopri5", "torchdiffeq:dopri5"], [3, 4, 9], [1e-2, 1e-4])
    assert [(c.method, c.steps, c.tolerance) for c in chosen] == [
        ("euler", 3, None), ("euler", 4, None), ("euler", 9, None), ("rk4", 1, None), ("rk4", 2, None),
        ("dopri5", None, 1e-2), ("dopri5", None, 1e-4),
        ("torchdiffeq:dopri5", None, 1e-2), ("torchdiffeq:dopri5", None, 1e-4),
    ]  # fmt: skip
    assert [c.label for c in chosen][2:6] == ["euler, 9 steps", "rk4, 1 step", "rk4, 2 steps", "dopri5, 1e-02"]
    with pytest.raises(InputError, match="Did you mean 'euler'"):
        configurations(["eulr"], [4])


def test_a_row_is_what_the_solver_did():
    # x' = x by Euler: (1 + 1/n)^n x_0, off by (e - (1 + 1/n)^n) |x_0|, in closed form.
    x_0 = torch.randn(21, 6, dtype=torch.float64)
    subject = Subject("growth", Field(lambda t, x: x, x_0.shape[1:]), x_0, math.e * x_0, batch_size=5)
    rows = measure([subject], [Configuration("euler", 1), Configuration("euler", 10)], repeats=2)
    norms = x_0.square().mean(1).sqrt().numpy()
    for row, n in zip(rows, (1, 10), strict=True):
        errors = (math.e - (1 + 1 / n) ** n) * norms
        assert (row["evaluations"], row["scenes"], row["converged"]) == (n, 21, 21)
        assert row["error"] == pytest.approx(np.median(errors))
        assert row["error_worst"] == pytest.approx(errors.max())
        assert row["error_p95"] == pytest.approx(np.sort(errors)[19])  # one of 21 scenes is worse
        assert 0 < row["seconds_quarter"] <= row["seconds"] <= row["seconds_three_quarters"] < 1
        assert row["timings"] == 2 * 5
        assert row["range_rms_m"] is None


def test_configurations_take_turns(monkeypatch):
    order = []

    def timed(configuration, flow, x_0):
        order.append(configuration.label)
        return configuration.solve(flow, x_0), 3.0 if configuration.steps == 8 else 0.1

    monkeypatch.setattr(work_precision, "timed", timed)
    (subject,) = problem_subjects(["gaussian"], scenes=2, elements=4)
    chosen = configurations(["euler"], [4, 8])
    ticks = []
    rows = measure([subject], chosen, repeats=3, progress=lambda: ticks.append(1))
    # The slow one has spent its patience after the first round.
    assert order == ["euler, 4 steps", "euler, 8 steps", "euler, 4 steps", "euler, 4 steps"]
    assert [row["seconds"] for row in rows] == [0.05, 1.5]
    assert len(ticks) == runs([subject], chosen, 3) == 6


def test_the_pareto_front_is_what_nothing_beats():
    work = [1, 2, 2, 3, 4, 5]
    error = [1.0, 0.5, 0.6, 0.5, math.inf, 0.1]
    assert pareto(work, error) == [True, True, False, False, False, True]


def test_a_lost_scene_is_on_no_front():
    # Euler on x' = x^2 from 3 overflows in float64 after some steps; the other scene is solved.
    x_0 = torch.tensor([[0.1], [1e200]], dtype=torch.float64)
    exact = x_0 / (1 - x_0)
    (row,) = measure(
        [Subject("blow-up", Field(lambda t, x: x * x, x_0.shape[1:]), x_0, exact, 2)], [Configuration("euler", 8)], 1
    )
    assert row["converged"] == 1
    assert not row["pareto_evaluations"]
    assert best_within([row], 100) is None
    assert "| 8 | none |  |" in best_table([row], {"8": 8}, "evaluations")


def test_metres_are_taken_where_both_return():
    image = torch.tensor([[[[10.0, 20.0, 0.0, 5.0]], [[0.1, 0.1, 0.0, 0.1]]]])
    other = torch.tensor([[[[13.0, 24.0, 7.0, 0.0]], [[0.1, 0.1, 0.1, 0.0]]]])
    median, rms, dropped = metres_apart(image, other)
    assert rms.tolist() == [pytest.approx(math.sqrt((9 + 16) / 2))]
    assert median.tolist() == [3.0]
    assert dropped.tolist() == [0.5]
    median, rms, dropped = metres_apart(torch.zeros(1, 1, 1, 2), torch.ones(1, 1, 1, 2))
    assert rms.isnan().all()
    assert median.isnan().all()
    assert dropped.tolist() == [1.0]


@pytest.mark.parametrize("name", ["gaussian", "two_modes", "rotating"])
def test_the_least_measurable_error_is_above_the_true_error_of_the_reference(name):
    problem = PROBLEMS[name]()
    x_0 = torch.randn(3, 16)
    found = reference(Field(problem, x_0.shape[1:]), x_0, steps=32, tolerance=1e-6)
    true = (found.x_1 - problem.solution(x_0, 1.0)).square().mean(1).sqrt()
    assert found.x_1.dtype == torch.float64
    assert true.max() < found.floor < 1e-2
    assert (found.disagreement > 0).all()


def test_without_a_reference_no_error_can_be_measured():
    x_0 = torch.ones(2, 2)  # x' = 9 x^2 has left for infinity at t = 1/9
    found = reference(Field(lambda t, x: 9 * x**2, x_0.shape[1:]), x_0, steps=32, tolerance=1e-4)
    assert found.floor == math.inf
    subject = Subject("blow-up", Field(lambda t, x: 9 * x**2, x_0.shape[1:]), x_0, found.x_1, 2, found.floor)
    rows = measure([subject], configurations(["euler"], [4]), repeats=1)
    page = work_precision_page(rows, "blow-up", found, [4], {}, "")
    assert "| 4 | none |  |" in " ".join(page.text)


def row(method: str, steps: int, error: float, problem: str = "p", seconds: float = 1.0, floor: float = 0.0) -> dict:
    return {
        "problem": problem, "method": method, "steps": steps, "tolerance": None, "label": f"{method}, {steps} steps",
        "evaluations": float(steps), "seconds": seconds, "error": error, "error_worst": error, "scenes": 2,
        "converged": 2, "floor": floor, "length": 10.0, "judged": error > floor,
    }  # fmt: skip


def test_the_table_names_the_best_within_each_budget():
    rows = [row("a", 4, 0.1), row("b", 4, 0.2), row("a", 8, 0.05), row("b", 8, 0.01), row("b", 16, 0.001)]
    lines = best_table(rows, {"4": 4, "8": 8, "16": 16}, "evaluations").splitlines()
    assert lines[2:] == ["| 4 | a, 4 steps | 0.1 |", "| 8 | b, 8 steps | 0.01 |", "| 16 | b, 16 steps | 0.001 |"]


def test_an_error_below_what_can_be_measured_does_not_win():
    rows = [row("cheap", 8, 2e-5, floor=1e-4), row("dear", 16, 1e-6, floor=1e-4)]
    assert best_within(rows, 16)["method"] == "cheap"
    assert "| 16 | cheap, 8 steps | 1.0e-04 or less |" in best_table(rows, {"16": 16}, "evaluations")


def test_the_solver_nearest_to_the_best_is_good_on_every_problem():
    rows = [
        row("special", 8, 1e-6, "one"), row("special", 8, 1.0, "two"), row("steady", 8, 1e-4, "one"),
        row("steady", 8, 1e-4, "two"), row("never", 16, 1e-9, "one"),
    ]  # fmt: skip
    # Ratios to the best: special 1 and 10^4, steady 10^2 and 1; `never` costs more than the budget.
    assert steadiest(rows, 8) == "steady"
    assert steadiest(rows[:1], 8) == "special"
    assert steadiest(rows, 4) is None


def test_the_table_is_about_the_budgets_asked_for():
    rows = [row("a", 6, 0.1), row("b", 12, 0.01), row("lost", 3, math.inf)]
    said = problems_text(rows, [12, 6, 3])
    assert "| problem | within 3 | within 6 | within 12 |" in said[1]
    assert "| **nearest to the best** | none | a | b |" in said[1]
    marked = [{**r, "pareto_evaluations": True, "pareto_seconds": False, "seconds_quarter": 1.0} for r in rows]
    marked = [{**r, "seconds_three_quarters": 1.0} for r in marked]
    page = work_precision_page(marked, None, None, [6], {}, "")
    assert "| **nearest to the best** | a |" in page.text[1]


def test_the_exact_problems_are_reported_with_what_was_not_solved():
    subjects = problem_subjects(["straight", "stiff_1e4"], scenes=3, elements=4)
    rows = measure(subjects, configurations(["euler", "midpoint", "dopri5"], [4, 8], [1e-3]), repeats=1)
    straight = {r["label"]: r for r in rows if r["problem"] == "straight"}
    assert straight["euler, 4 steps"]["error"] < 1e-12
    assert not straight["euler, 4 steps"]["judged"]  # float64's rounding is nobody's merit
    said = " ".join(problems_text(rows, [4, 8]))
    assert "| straight | 2 solvers, 1.0e-09 or less |" in said
    assert "| stiff_1e4 | none |" in said  # explicit steps of 1/4 end farther away than they began
    page = work_precision_page(rows, None, None, [4, 8], {"exact problems": 0}, "r2flow report work-precision")
    assert set(page.figures) == {"exact_problems", "exact_problems_time"}


def test_unknown_problems_are_refused():
    with pytest.raises(InputError, match="Did you mean 'gaussian'"):
        problem_subjects(["gausian"])


def test_the_verb_writes_the_report(r2flow, saved, tmp_path):  # noqa: F811
    out = tmp_path / "reports"
    code, said, _ = r2flow(
        "report", "work-precision", "-c", saved[0], "-o", out, "--num", 2, "--solvers", "euler,heun2,dopri5",
        "--budgets", "2,4", "--tolerances", "1e-2", "--problems", "gaussian,rotating", "--problem-scenes", 3,
        "--reference-steps", 8, "--reference-tolerance", 1e-4, "--repeats", 1,
    )  # fmt: skip
    assert code == 0
    figures = {"work_precision.png", "exact_problems.png", "exact_problems_time.png"}
    assert {path.name for path in out.iterdir()} == figures | {f"work_precision.{end}" for end in ("csv", "json", "md")}
    assert f"**{saved[0]}**, 2 scans, against its own tight solution" in said
    assert "| within | configuration | error |" in said
    with (out / "work_precision.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert len(rows) == 3 * 5  # two problems and the checkpoint; two steps of two methods and one tolerance
    of_checkpoint = [row for row in rows if row["problem"] == str(saved[0])]
    assert all(float(row["drop_differs"]) <= 1 for row in of_checkpoint)
    assert json.loads((out / "work_precision.json").read_text())["origin"]["seeds"] == {
        "scenes": 0,
        "exact problems": 0,
    }


def test_bad_input_is_one_line(r2flow, saved, tmp_path):  # noqa: F811
    out = tmp_path / "o"
    for arguments, words in (
        (("--solvers", "eulr"), "Did you mean 'euler'?"),
        (("--budgets", "4,x"), "--budgets must be positive numbers"),
        (("--tolerances", "-1"), "--tolerances must be positive numbers"),
        (("--budgets", "1", "--solvers", "rk4"), "leaves no solver a step"),
        (("--reference-tolerance", "inf"), "must be positive and finite"),
        (("--problems", "none"), "nothing to measure"),
        (("--problems", "gausian"), "Did you mean 'gaussian'?"),
        (("-c", tmp_path / "none"), "no checkpoint"),
    ):
        code, _, err = r2flow("report", "work-precision", *arguments, "-o", out)
        assert code == 2
        assert words in err
        assert len(err.splitlines()) == 1
        assert not out.exists()


def test_the_recommended_solver_has_the_fewest_evaluations_within_five_centimetres():
    def row(method, evaluations, error, metres, **more):
        return {
            "method": method, "label": f"{method}, 8 steps", "steps": 8, "grid": "power:1.75",
            "evaluations": evaluations,
            "error": error, "range_rms_m": metres, "floor": 0.0, "length": 1.0, "scenes": 2, "converged": 2, **more,
        }  # fmt: skip

    rows = [
        row("euler", 4, 1e-1, 3.0), row("adams3", 16, 1e-3, 0.03), row("heun3", 16, 2e-3, 0.05),
        row("lost", 2, 1e-5, 0.001, converged=1), row("rk4", 32, 1e-5, 1e-4),
    ]  # fmt: skip
    assert recommendation(rows) == (
        "For this flow: adams3 on the grid power:1.75, 16 evaluations, error 0.001, 0.03 m."
    )
    assert recommendation(rows[:1]).startswith("For this flow: euler on the grid power:1.75, 4 evaluations")
    assert recommendation([rows[3]]) == "For this flow: no configuration solves it."
    assert "error 0.1." in recommendation([row("euler", 4, 1e-1, None)])
    assert "For this flow: dopri5, 1e-03, 20 eval" in recommendation(
        [row("dopri5", 20, 1e-4, 0.01, steps=None, label="dopri5, 1e-03")]
    )


def test_a_flow_s_own_solver_is_measured_on_its_own_grid():
    one = Field(lambda t, x: x, (2,))
    one.sampler = Sampler("adams3", 8, grid="power:2.5")
    for method, grid in (("adams3", "power:2.5"), ("adams4", "power:1.75"), ("midpoint", "uniform")):
        assert Configuration(method, 4).sampler(one) == Sampler(method, 4, grid=grid)
