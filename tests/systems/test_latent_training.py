"""Score models and latent diffusions as they are composed for training."""

from pathlib import Path

import pytest
import torch

from r2flow.errors import InputError
from r2flow.generators import build_generator
from r2flow.runs.lineage import Parent
from r2flow.training import check, compose

FULL = {"lidargen": 29_694_082, "lidm_autoencoder": 15_070_361}


@pytest.mark.parametrize("name", FULL)
def test_a_published_recipe_is_built(name: str, tmp_path: Path):
    config = compose([f"experiment={name}", "data.root=/nowhere", "trainer.accelerator=cpu", f"run_dir={tmp_path}"])
    config = check(config)
    with torch.device("meta"):
        assert sum(p.numel() for p in build_generator({**config}).parameters()) == FULL[name]


def test_the_published_recipe_with_positions_starts_from_its_autoencoder(tmp_path: Path):
    common = ["data.root=/nowhere", "trainer.accelerator=cpu", f"run_dir={tmp_path}"]
    with pytest.raises(InputError, match=r"give stage\.init=RUN"):
        check(compose(["experiment=lidm", "stage.init=null", *common]))
    parent = Parent(compose(["experiment=lidm_autoencoder", *common]), tmp_path)
    config = check(compose(["experiment=lidm_ape", *common]), parent=parent)
    with torch.device("meta"):
        generator = build_generator(config)
    assert sum(p.numel() for p in generator.parameters()) == 15_070_361 + 257_751_560 + 524_288
