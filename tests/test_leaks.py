"""Long work holds no more memory and no more files at its end than after its first fifth."""

import gc
import os
from pathlib import Path

import pytest
import torch
from lightning.pytorch.callbacks import LambdaCallback

from r2flow.generators import build_generator
from r2flow.model.sampling import sample
from r2flow.training import build, compose, fit
from tests.conftest import CONFIG
from tests.training.conftest import scans, tiny  # noqa: F401  a fixture

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads its memory from /proc"),
]

ALLOWED = 8 * 2**20  # bytes: pages that the allocator keeps


class Held:
    """(bytes of memory, open files) of this process, noted on the way."""

    def __init__(self) -> None:
        self.noted: list[tuple[int, int]] = []

    def note(self) -> None:
        gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.noted.append((pages * os.sysconf("SC_PAGE_SIZE"), len(os.listdir("/proc/self/fd"))))

    def check(self) -> None:
        (memory, files), *_, (memory_now, files_now) = self.noted
        assert files_now <= files, self.noted
        assert memory_now - memory < ALLOWED, self.noted


@pytest.mark.parametrize("workers", [0, 2])
def test_two_thousand_training_steps(scans, tmp_path, workers):  # noqa: F811
    options = tiny(
        scans, f"run_dir={tmp_path / 'run'}", "trainer.max_steps=2000", "callbacks.checkpoint.every=100",
        "trainer.val_check_interval=100", f"data.workers={workers}", "data.memory_gib=0", "samples.num=0",
        "loggers=[csv,tensorboard]",
    )  # fmt: skip
    run, held = build(compose(options)), Held()
    noting = LambdaCallback(
        on_train_batch_end=lambda trainer, *_: trainer.global_step % 400 or held.note()
    )
    run.trainer.callbacks.append(noting)
    assert fit(run).finished
    assert len(held.noted) == 5
    held.check()


def test_a_thousand_samples():
    torch.manual_seed(0)
    generator, held = build_generator(CONFIG).eval(), Held()
    for number, drawn in enumerate(sample(generator, 1000, 0, steps=2, batch_size=10), 1):
        assert len(drawn.images) == 10
        if number % 20 == 0:
            held.note()
    held.check()
