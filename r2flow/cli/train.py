"""`r2flow train` and `r2flow pairs`."""

import os
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import DeviceOption, PrecisionOption, SamplerOptions, grouped
from r2flow.devices import choose_device


@app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
    epilog="Example: r2flow train data=kitti_raw data.root=FOLDER backbone=hdit_small",
)
def train(context: typer.Context) -> int:
    """Train a model; set config keys as KEY=VALUE. --help lists the choices, --cfg job prints all keys."""
    from r2flow.runs.launch import main

    return main(context.args, *context.obj)


@app.command(epilog="Example: torchrun --nproc-per-node 8 -m -- r2flow pairs runs/r2flow_1rf --num 1000000")
@grouped
def pairs(
    model: Annotated[str, typer.Argument(help="A model, a run folder or a checkpoint file.")],
    how: SamplerOptions,
    num: Annotated[int, typer.Option(min=1, help="Total number of pairs.")] = 1000,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output folder. Default: `pairs` in the run folder.")
    ] = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Pairs per batch.")] = 16,
    shard_mib: Annotated[float, typer.Option(min=0.001, help="Shard size in MiB.")] = 16.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    precision: PrecisionOption = "32-true",
    device: DeviceOption = "auto",
) -> None:
    """Generate reflow pairs with a flow; several processes share the missing or damaged pairs.

    `python train.py experiment=reflow stage.parent=RUN` generates pairs itself; this verb only generates, also under
    torchrun or as a SLURM array, with the settings of `data.pairs`. Default sampler: adams3 in 32 steps; the paper uses
    --sampler dopri5. renoise samples a flow map in several jumps, as targets for its first jump.
    """
    from r2flow.data.options import PairOptions
    from r2flow.data.pairs import PairStore, default_folder, make_pairs
    from r2flow.model.lineage import find_parent

    where = choose_device(device)
    if where == "cuda":
        import torch

        local = int(os.environ.get("LOCAL_RANK") or os.environ.get("SLURM_LOCALID", "0"))
        where = f"cuda:{local % torch.cuda.device_count()}"  # SLURM may expose one GPU per task
    parent = find_parent(model)
    assert parent.checkpoint is not None
    flow = parent.checkpoint
    options = {
        "sampler": {"name": "adams3", **how.given}, "precision": precision, "num": num, "batch_size": batch_size,
        "shard_mib": shard_mib, "seed": seed,
    }  # fmt: skip
    record = parent.record()
    chosen = PairOptions(**options, parent=record["weights"], first=record["first_pair"])
    store = PairStore(out or default_folder(flow.path), chosen, flow.encoding.shape, flow.generator.noise_shape)
    make_pairs(store, flow.generator.to(where), wait=False)
    if missing := store.missing_pairs():
        print(f"{store.folder}: other processes are still generating about {min(missing, num)} of {num} pairs")
    else:
        shards = store.shards
        size = sum(store.files(shard)[0].stat().st_size for shard in shards)
        print(f"{store.folder}: all {num} pairs, {len(shards)} shard{'s' * (len(shards) != 1)}, {size / 2**20:.0f} MiB")
