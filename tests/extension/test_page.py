"""docs/extend.md: every block is a plug-in that works."""

import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from r2flow.metrics import METRICS
from tests.conftest import ROOT
from tests.extension.conftest import TINY, loaded, r2flow

BLOCKS = dict(
    re.findall(
        r"^```python\n# (\w+)\.py\n(.*?)^```", (ROOT / "docs/extend.md").read_text(), re.M | re.S
    )
)


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    for name, code in BLOCKS.items():
        Path(f"{name}.py").write_text(code)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "choices"),
    [
        ("my_backbone", ["backbone=my_backbone", "backbone.channels=4"]),
        ("my_unet", ["backbone=my_unet", "backbone.width=4"]),
        ("near_loss", ["stage=near_loss", "stage.weight=2"]),
        ("corridors", ["data=corridors", "backbone=hdit_tiny"]),
    ],
)
def test_a_plug_in_of_the_page_trains(plugins: Path, name: str, choices: list[str]):
    tiny = [one for one in TINY if name != "corridors" or not one.startswith("data.scenes")]
    done = r2flow("train", f"--plugin={name}.py", *tiny, *choices, "run_dir=run")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_adapter_of_the_page_turns_the_time_of_the_flow_into_steps_of_noise():
    import torch

    space = {}
    with loaded():
        exec(BLOCKS["my_unet"], space)
    network = space["MyUNet"](2, 2)
    network.unet.forward = lambda sample, timestep: SimpleNamespace(sample=timestep)
    x = torch.zeros(3, 2, 4, 8)
    assert network(torch.tensor([0.0, 0.25, 1.0]), x).tolist() == [1000, 750, 0]


def test_the_sampler_of_the_page_takes_a_share_of_each_step():
    import torch

    from r2flow.samplers import SAMPLERS

    with loaded():
        exec(BLOCKS["shrunken"], {"__name__": "shrunken"})
        sampler = SAMPLERS["shrunken"](steps=4, share=0.5)
    generator = SimpleNamespace(field=lambda condition: lambda t, x: torch.full_like(x, 3.0))
    drawn = sampler(generator, torch.ones(2, 2, 4, 8), None, None, lambda: None)
    # x = 1 + 0.5 * 3 * (1 - 0)
    torch.testing.assert_close(drawn.x, torch.full((2, 2, 4, 8), 2.5))


def test_the_metric_of_the_page_is_a_difference_of_means(plugins: Path):
    import torch

    with loaded():
        exec(BLOCKS["mean_range"], {})
        metric = METRICS["mean_range"](sensor="hdl64e_small")
        for r, real in ((10.0, True), (12.5, False)):
            metric.update(torch.full((3, 1, 32, 256), r), real=real)
        assert metric.compute() == {"mean_range": pytest.approx(2.5)}
        del METRICS._entries["mean_range"]
