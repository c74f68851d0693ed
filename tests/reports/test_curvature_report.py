import json
import math

import numpy as np
import pytest
import torch
from torch import nn

from r2flow.base.noise import Draws
from r2flow.reports.curvature import _curvature_rows, curvature_page, measure_paths, summary
from r2flow.reports.tables import markdown
from tests.conftest import SENSOR
from tests.test_sampling import flow

pytestmark = pytest.mark.usefixtures("quick_pictures")
STEPS = 16


class Falling(nn.Module):
    """v = -a (x + 1) t: every pixel is drawn to -1, the dropped ray, the faster the later."""

    def __init__(self, a: float | torch.Tensor) -> None:
        super().__init__()
        self.a = nn.Parameter(torch.as_tensor(a), requires_grad=False)

    def forward(self, t, x):
        return -self.a * (x + 1) * t


def by_hand(a: np.ndarray, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Every state and velocity of Euler's path, (num, n + 1, elements) and (num, n, elements), in
    numpy.
    """
    x = Draws(5, range(num)).start((2, *SENSOR.shape)).double().numpy().reshape(num, -1)
    a, states, velocities = np.resize(a, x.shape[1]), [x], []
    for k in range(STEPS):
        velocities.append(-a * (states[-1] + 1) * k / STEPS)
        states.append(states[-1] + velocities[-1] / STEPS)
    return np.stack(states, 1), np.stack(velocities, 1)


@pytest.mark.parametrize("batch_size", [1, 2, 3])
def test_the_figures_are_those_of_paths_kept_whole(batch_size):
    # a column's paths bend most where others no longer do
    rates = torch.linspace(1, 9, SENSOR.columns)
    found = measure_paths(flow(Falling(rates)), "falling", 3, STEPS, 5, batch_size, most_curved=7)
    x, v = by_hand(rates.numpy(), 3)
    d = x[:, -1] - x[:, 0]
    s = ((d[:, None] - v) ** 2).sum(-1)
    np.testing.assert_allclose(found.s, s, rtol=1e-4)
    np.testing.assert_allclose(found.squared_length, (d**2).sum(-1), rtol=1e-5)
    bends = ((d[:, None] - v) ** 2).mean(1)
    most = np.argsort(-bends.ravel())[:7]
    paths = x.transpose(0, 2, 1).reshape(-1, STEPS + 1)[most]
    np.testing.assert_allclose(found.trajectories, paths, atol=1e-5)
    row = summary("falling", found)
    assert row["integral"] == pytest.approx(s.mean(), rel=1e-4)
    rows = _curvature_rows({"falling": found})
    assert [r["t"] for r in rows] == [k / STEPS for k in range(STEPS)]
    assert rows[3]["s"] == pytest.approx(s[:, 3].mean(), rel=1e-4)


def test_the_page_compares_the_flows():
    slopes = {"slow": 0.5, "fast": 4.0}
    flows = {name: measure_paths(flow(Falling(a)), name, 1, STEPS, 5) for name, a in slopes.items()}
    page = curvature_page(flows, 5)
    said = markdown(*page.text[1])
    # s / |d|^2 does not change when a straight-line velocity is scaled; here the slower one is
    # nearer to v = c t, whose variance over squared mean is (1/12) / (1/4) = 1/3.
    assert 0.9 / 3 < summary("slow", flows["slow"])["integral_normalised"] < 1.2 / 3
    for row in (summary(*one) for one in flows.items()):
        assert (
            f"| {row['checkpoint']} | {row['integral']:.3g} | {row['integral_normalised']:.3g} |"
            in said
        )
    assert [len(page.figures[name].axes) for name in ("curvature", "trajectories")] == [2, 2]


def test_a_flow_that_goes_nowhere_has_no_normalised_integral():
    still = measure_paths(flow(Falling(0.0)), "still", 1, 4, 5)
    page = curvature_page({"still": still}, 5)
    assert math.isnan(summary("still", still)["integral_normalised"])
    assert "| still | 0 | - |" in markdown(*page.text[1])


def test_a_flow_of_nan_is_said(caplog):
    measure_paths(flow(Falling(math.nan)), "broken", 2, 4, 5)
    assert "broken: s(t) is not finite for 2 of 2 scans" in caplog.text


def test_the_verb_writes_the_report(r2flow, saved, tmp_path):
    path, out = saved[0], tmp_path / "reports"
    copy = path.with_name("step-00000009.ckpt")
    copy.write_bytes(path.read_bytes())
    said = r2flow("report", "curvature", path, copy, "-o", out, "--steps", 4, "--num", 2).said
    figures = {f"{name}.{end}" for name in ("curvature", "trajectories") for end in ("png", "pdf")}
    assert {file.name for file in out.iterdir()} == figures | {"curvature.json", "curvature.md"}
    assert str(out / "curvature.md") in said
    content = json.loads((out / "curvature.json").read_text())
    assert len(content["rows"]) == 2 * 4
    assert {row["checkpoint"] for row in content["summary"]} == {str(path), str(copy)}
    assert content["origin"]["command"].startswith(f"r2flow report curvature {path}")
