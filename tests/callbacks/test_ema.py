import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import LambdaCallback
from r2flow.callbacks.ema import EMA, averaged_weights
from torch import nn

from tests.conftest import quiet_trainer
from tests.reference import load_case


@pytest.mark.parametrize(
    ("rule", "decays"),
    [
        ("constant", [0, 0.9, 0.9, 0.9]),
        ("ratio", [0, 2 / 11, 0.25, 0.9]),
        ("power", [0, 0, 1 - 2 ** (-2 / 3), 0.9]),
    ],
)
def test_decays_begin_behind_the_warm_up_and_are_bounded(rule: str, decays: list[float]):
    """LiDARGen's is constant, LiDM's (1 + n) / (10 + n) from n = 1."""
    ema = EMA(0.9, every=1, warmup_steps=2, rule=rule)
    found = []
    for step in (1, 2, 3, 999):
        ema.should_update(step)
        # decay of an average of 1 towards weights of 0
        found.append(ema._average(torch.tensor(1.0), torch.tensor(0.0), None).item())
    assert found == pytest.approx(decays)


class Scripted(L.LightningModule):
    """A module whose weight takes given values, step by step."""

    def __init__(self, values: list[float]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))
        self.values = values
        self.automatic_optimization = False

    def training_step(self, batch, batch_idx):
        self.optimizers().step()
        with torch.no_grad():
            self.weight.fill_(self.values[batch_idx])

    def validation_step(self, batch, batch_idx):
        self.seen = self.weight.item()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.0)


def trained(ema: EMA, values: list[float], tmp_path) -> tuple[Scripted, list[tuple[float, float]]]:
    """(weight, average) after each step, and the module, which is validated after the last."""
    module, trace, loader = Scripted(values), [], torch.utils.data.DataLoader(range(len(values)))

    def look(trainer, *_):
        with averaged_weights(trainer, module):
            average = module.weight.item()
        trace.append((module.weight.item(), average))

    callbacks = [ema, LambdaCallback(on_train_batch_end=look)]
    trainer = quiet_trainer(
        tmp_path, max_steps=len(values), callbacks=callbacks, num_sanity_val_steps=0
    )
    trainer.fit(module, loader, loader)
    return module, trace


def test_the_average_follows_the_reference_s_trace(shared, tmp_path):
    reference = torch.load(shared / "oracle" / "training.pt", weights_only=False)["ema"]
    _, values, averages, _ = map(list, zip(*reference["trace"], strict=True))
    ema = EMA(reference["beta"], reference["update_every"], reference["update_after_step"])
    _, trace = trained(ema, values, tmp_path)
    assert [average for _, average in trace] == pytest.approx(averages, abs=1e-5)


@pytest.mark.parametrize(
    ("name", "rule"), [("lidm_diffusion", "ratio"), ("lidargen_objective", "constant")]
)
def test_the_average_is_the_published_from_the_first_step_on(shared, tmp_path, name, rule):
    case = load_case(shared, f"{name}.pt")["ema"]
    # from 0
    values, averages = (
        (case[key][1:] - case["ema"][0])[:, 0, 0].tolist() for key in ("online", "ema")
    )
    _, trace = trained(
        EMA(case.get("mu", 0.9999), every=1, warmup_steps=0, rule=rule), values, tmp_path
    )
    assert [average for _, average in trace] == pytest.approx(averages, abs=1e-6)


def test_validation_sees_the_average_and_leaves_the_weights(tmp_path):
    module, trace = trained(EMA(decay=0.5, every=1, warmup_steps=0), [1.0, 2.0, 3.0, 4.0], tmp_path)
    raw, average = trace[-1]
    assert raw == 4.0
    # By hand: decays 0, 1 - 2^(-2/3) = 0.370, then 0.5, 0.5 at most: 1 -> 1.630 -> 2.315 -> 3.157.
    assert average == pytest.approx(3.1575, abs=1e-3)
    assert module.seen == pytest.approx(average)
    assert module.weight.item() == pytest.approx(average)  # after fit the module is the model


@pytest.mark.parametrize(("warmup", "steps"), [(0, 1), (3, 2), (3, 6), (3, 10), (20, 15)])
def test_a_run_that_ends_before_its_average_begins_has_the_weights_that_it_learned(
    tmp_path, warmup: int, steps: int
):
    """Until then the average is that of the last copy; behind the warm-up it moves by half."""
    values = [float(n) for n in range(1, steps + 1)]
    _, trace = trained(EMA(0.5, every=10, warmup_steps=warmup), values, tmp_path)
    copied = [values[n - n % 10] for n in range(steps - 1)]
    assert trace == list(zip(values, [*copied, values[-1]], strict=True))
