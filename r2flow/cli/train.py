"""`r2flow train` and `r2flow pairs`."""

import os
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from r2flow.base.devices import choose_device
from r2flow.cli.app import app
from r2flow.cli.options import (
    BatchOption,
    DeviceOption,
    ModelArgument,
    PrecisionOption,
    SamplerOptions,
    SeedOption,
    grouped,
    several,
)


@app.command(
    rich_help_panel="Make",
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
    epilog="Example: r2flow train data=kitti_raw data.root=FOLDER backbone=hdit_small",
)
def train(context: typer.Context) -> int:
    """Train a model; set config keys as KEY=VALUE. --help lists the choices, --cfg job prints all
    keys.
    """
    from r2flow.runs.launch import main

    return main(context.args, *context.obj)


@app.command(
    rich_help_panel="Make",
    epilog="Example: torchrun --nproc-per-node 8 -m -- r2flow pairs runs/r2flow_1rf --num 1000000",
)
@grouped
def pairs(
    model: ModelArgument,
    how: SamplerOptions,
    num: Annotated[int, Option(min=1, help="Total number of pairs.")] = 1000,
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="Output folder. Default: `pairs` in the run folder."),
    ] = None,
    batch_size: BatchOption = 16,
    shard_mib: Annotated[float, Option(min=0.001, help="Shard size in MiB.")] = 16.0,
    seed: SeedOption = 0,
    precision: PrecisionOption = "32-true",
    device: DeviceOption = "auto",
) -> None:
    """Generate reflow pairs with a flow; several processes share the missing or damaged pairs.

    `python train.py experiment=reflow stage.parent=RUN` generates pairs itself; this verb only
    generates, also under torchrun or as a SLURM array, with the settings of `data.pairs`. Default
    sampler: adams3 in 32 steps; the paper uses --sampler dopri5. renoise samples a flow map in
    several jumps, as targets for its first jump.
    """
    import torch

    from r2flow.base.registry import construct
    from r2flow.data.options import PairOptions
    from r2flow.data.pairs import PairStore, default_folder, make_pairs
    from r2flow.model.lineage import find_parent

    where = choose_device(device)
    if where == "cuda":  # SLURM may expose one GPU per task
        local = int(os.environ.get("LOCAL_RANK") or os.environ.get("SLURM_LOCALID", "0"))
        where = f"cuda:{local % torch.cuda.device_count()}"
    parent = find_parent(model)
    assert parent.checkpoint is not None
    flow = parent.checkpoint
    record = parent.record()
    options = {
        "sampler": {"name": "adams3", **how.fields},
        "precision": precision,
        "num": num,
        "batch_size": batch_size,
        "shard_mib": shard_mib,
        "seed": seed,
        "parent": record.weights,
        "first": record.first_pair,
    }
    pairing = construct("pairs", PairOptions, options)
    folder = out or default_folder(flow.path)
    store = PairStore(folder, pairing, flow.encoding.shape, flow.generator.noise_shape)
    make_pairs(store, flow.generator.to(where), wait=False)
    missing = store.missing_pairs()
    if missing:
        print(
            f"{folder}: other processes are still generating about {min(missing, num)} of {num} "
            "pairs"
        )
        return
    size = sum(store.file(shard).stat().st_size for shard in store.shards)
    shards = several(len(store.shards), "shard")
    print(f"{folder}: all {num} pairs, {shards}, {size / 2**20:.0f} MiB")
