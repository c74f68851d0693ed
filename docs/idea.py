"""Draws docs/images/idea.svg, a rectified flow of one number: python docs/idea.py

The data are two groups of numbers, so that the velocity of the 1-RF and its paths are known by
formula. Paths of a number cannot cross, and so the 2-RF is exactly straight.
"""

from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import torch
from torch import Tensor

from r2flow.flow.problems import TwoModes

PICTURE = Path(__file__).parent / "images" / "idea.svg"
NOISE, DATA, PATH, STEP = "#4a7fc1", "#2f9e62", "#9aa5b1", "#d9480f"
FLOW = TwoModes(apart=1.6, std=0.3)
START = 0.22  # of the path that is followed in steps

plt.rcParams.update(
    {"svg.hashsalt": "r2flow", "svg.fonttype": "none", "font.size": 11, "axes.titlesize": 12.5}
)


def euler(x: float, steps: int) -> list[float]:
    """States after 0, 1, ..., `steps` even steps along the velocity."""
    states = [x]
    for i in range(steps):
        t, state = (
            torch.tensor(i / steps, dtype=torch.float64),
            torch.tensor([states[-1]], dtype=torch.float64),
        )
        states.append(states[-1] + float(FLOW(t, state)) / steps)
    return states


def main() -> None:
    figure, (learn, draw, straight) = plt.subplots(
        1, 3, figsize=(11, 3.7), sharey=True, layout="constrained"
    )
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(24, generator=generator, dtype=torch.float64)
    data = 0.3 * torch.randn(24, generator=generator, dtype=torch.float64) + torch.tensor(
        [-1.6, 1.6]
    ).repeat(12)
    starts = torch.linspace(-1.9, 1.9, 20, dtype=torch.float64)
    times = torch.linspace(0, 1, 49)
    paths = torch.stack([FLOW.solution(starts, float(t)) for t in times])

    def lines(ax: plt.Axes, t: Tensor, x: Tensor) -> None:
        ax.plot(t, x, color=PATH, lw=1)
        ax.scatter(torch.zeros(x.shape[1]), x[0], color=NOISE, s=18, zorder=3)
        ax.scatter(torch.ones(x.shape[1]), x[-1], color=DATA, s=18, zorder=3)

    lines(learn, times[[0, -1]], torch.stack([noise, data]))
    learn.set_title("1. Learn from straight lines")
    lines(draw, times, paths)
    exact = [
        float(FLOW.solution(torch.tensor([START], dtype=torch.float64), float(t))) for t in times
    ]
    draw.plot(times, exact, color=STEP, lw=1.5, ls=":")
    draw.plot([0, 0.5, 1], euler(START, 2), color=STEP, marker="o", lw=2)
    draw.text(0.97, -0.1, "2 steps miss the end", ha="right", va="center", color=STEP)
    draw.set_title("2. Draw by following the velocity")
    lines(straight, times[[0, -1]], paths[[0, -1]])
    straight.plot([0, 1], [exact[0], exact[-1]], color=STEP, marker="o", lw=2)
    straight.text(0.97, -0.1, "1 step is enough", ha="right", va="center", color=STEP)
    straight.set_title("3. Straighten")
    for ax in (learn, draw, straight):
        ax.set_xticks([0, 1], ["noise\nt = 0", "data\nt = 1"])
        ax.set_yticks([])
        ax.spines[:].set_visible(False)
    figure.savefig(PICTURE, metadata={"Date": None})


if __name__ == "__main__":
    main()
