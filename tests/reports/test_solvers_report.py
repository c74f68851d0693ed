"""r2flow report solvers: rows against closed forms, the choice among them, and the report."""

import json
import logging
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r2flow.flow.problems import PROBLEMS
from r2flow.reports.solvers import (
    Subject,
    best_within,
    cheapest,
    checkpoint_subject,
    configurations,
    measure,
    problem_subjects,
    solvers_page,
)
from r2flow.reports.tables import markdown
from tests.fields import Field
from tests.test_sampling import GaussianFlow

pytestmark = pytest.mark.usefixtures("quick_pictures")


def test_a_row_is_what_the_solver_did():
    # x' = x by Euler: (1 + 1/n)^n x_0, off by (e - (1 + 1/n)^n) |x_0|, in closed form.
    x_0 = torch.randn(20, 6, dtype=torch.float64)
    subject = Subject("growth", lambda t, x: x, x_0, math.e * x_0, batch_size=5)
    rows = measure([subject], configurations(["euler"], [1, 10]))
    norms = x_0.square().mean(1).sqrt().numpy()
    for row, n in zip(rows, (1, 10), strict=True):
        errors = (math.e - (1 + 1 / n) ** n) * norms
        assert (row["evaluations"], row["scans"], row["converged"]) == (n, 20, 20)
        assert row["error"] == pytest.approx(np.median(errors))
        assert row["error_worst"] == pytest.approx(errors.max())
        assert 0 < row["seconds"] < 1


def trained(problem):
    return SimpleNamespace(encoding=None, generator=Field(problem, (16,)))


@pytest.mark.parametrize("name", ["gaussian", "two_modes", "rotating"])
def test_the_least_measurable_error_is_above_the_true_error_of_the_reference(name):
    problem = PROBLEMS[name]()
    found = checkpoint_subject(trained(problem), name, num=3, steps=32, tolerance=1e-6)
    true = (found.x_1 - problem.solution(found.x_0, 1.0)).square().mean(1).sqrt()
    assert found.x_1.dtype == torch.float64
    assert true.max() < found.floor < 1e-2


def test_without_a_reference_no_error_can_be_measured():
    found = checkpoint_subject(
        trained(lambda t, x: 9 * x**2), "blow-up", num=2, steps=32, tolerance=1e-4
    )
    assert found.floor == math.inf
    assert best_within(measure([found], configurations(["euler"], [4], [])), 4) is None


def row(
    method: str, evaluations: float, error: float, metres: float = 1.0, floor: float = 0.0, **more
) -> dict:
    return {
        "problem": "p", "method": method, "label": method, "evaluations": evaluations, "seconds": 1.0, "error": error,
        "range_rms_m": metres, "scans": 2, "converged": 2, "floor": floor, "length": 10.0, **more,
    }  # fmt: skip


def test_an_error_below_what_can_be_measured_does_not_win():
    rows = [row("cheap", 8, 2e-5, floor=1e-4), row("dear", 16, 1e-6, floor=1e-4)]
    assert best_within(rows, 16)["method"] == "cheap"


def test_the_cheapest_solver_within_an_error_of_the_range():
    rows = [
        row("euler", 4, 1e-1, 3.0), row("adams3", 16, 1e-3, 0.03), row("heun2", 16, 2e-3, 0.05),
        row("lost", 2, 1e-5, 0.001, converged=1), row("rk4", 32, 1e-5, 1e-4),
    ]  # fmt: skip
    assert cheapest(rows, 0.05)["method"] == "adams3"
    assert cheapest(rows, 0.01)["method"] == "rk4"
    assert cheapest(rows, 1e-5) is None


def test_the_exact_problems_are_reported_with_what_was_not_solved():
    subjects = problem_subjects(["straight", "stiff_1e4"], scans=3, elements=4)
    rows = measure(
        subjects, configurations(["euler", "midpoint", "torchdiffeq:dopri5"], [4, 8], [1e-3])
    )
    # whatever a flow's own sampler is
    assert rows[0]["options"].startswith("--sampler euler:finish=0 --steps 4")
    # as `r2flow sample` takes it
    assert rows[-1]["options"] == "--sampler torchdiffeq:method=dopri5 --tolerance 0.001"
    straight = {r["label"]: r for r in rows if r["problem"] == "straight"}
    assert straight["euler, 4 steps"]["error"] < 1e-12
    page = solvers_page(rows, None, [4, 8], {})
    assert "| stiff_1e4 | none |" in markdown(
        *page.text[2]
    )  # explicit steps of 1/4 end farther than x_0
    assert set(page.figures) == {"solvers_problems"}
    axes = page.figures["solvers_problems"].axes[0]
    # larger ones overlap
    assert {text.get_size() for text in axes.get_xticklabels(which="both")} == {8}


def test_what_comes_after_the_time_has_no_row():
    methods = configurations(["euler", "rk4"], [4], [])
    rows = measure(problem_subjects(["straight"], 2, 4), methods, until=-1.0)
    assert [row["method"] for row in rows] == ["euler"]


def test_an_adaptive_sampler_says_what_each_scan_took(r2flow, saved, tmp_path):
    options = [
        "--sampler",
        "dopri5",
        "--tolerance",
        "0.5",
        "--num",
        "2",
        "--pictures",
        "0",
        "--format",
        "npy",
        "--out",
    ]
    said = r2flow("sample", saved[0], *options, tmp_path).said
    each, mean = re.search(r"evaluations of each scan: (.*); mean (.*)\n", said).groups()
    assert float(mean) == np.mean([int(count) for count in each.split(", ")]) >= 6


def test_the_verb_writes_the_report(r2flow, saved, tmp_path, monkeypatch, caplog):
    # which the verb raises; set back after the test
    caplog.set_level(logging.NOTSET, "r2flow.flow")

    def quick(checkpoint, *given, **options):
        # random weights have narrow pulses, which few steps miss
        checkpoint.generator.backbone = GaussianFlow()
        return checkpoint_subject(checkpoint, *given, **options | {"steps": 16, "tolerance": 1e-3})

    monkeypatch.setattr("r2flow.reports.solvers.checkpoint_subject", quick)
    monkeypatch.setattr("r2flow.base.plugins._loaded", {"of/mine.py": "of/mine.py"})
    out = tmp_path / "reports"
    options = [
        "--num",
        2,
        "--samplers",
        "euler,heun2,dopri5",
        "--budgets",
        "2,4",
        "--problems",
        "gaussian,rotating",
    ]
    said = r2flow("report", "solvers", saved[0], "-o", out, *options).said
    figures = {
        f"{name}.{end}" for name in ("solvers", "solvers_problems") for end in ("png", "pdf")
    }
    assert {path.name for path in out.iterdir()} == figures | {
        f"solvers.{end}" for end in ("json", "md")
    }
    assert f"**{saved[0]}**, 2 scans, against its reference solution" in said
    assert f"`r2flow sample {saved[0]} --plugin=of/mine.py --sampler " in said
    rows = json.loads((out / "solvers.json").read_text())["rows"]
    # two problems and the checkpoint; two steps of two methods and four tolerances
    assert len(rows) == 3 * 8
    # most steps, or the lowest tolerance, are the closest to the reference
    for name in ("euler", "heun2", "dopri5"):
        drawn = [row for row in rows if (row["problem"], row["method"]) == (str(saved[0]), name)]
        errors = [row["range_rms_m"] for row in drawn]
        assert errors[0] == max(errors) > min(errors) == errors[-1]
        assert drawn[-1]["drop_differs"] <= drawn[0]["drop_differs"] < 0.1
        exact = [
            row["error"] for row in rows if (row["problem"], row["method"]) == ("rotating", name)
        ]
        # of a smooth field, every step of the scale counts
        assert exact == sorted(set(exact), reverse=True)
