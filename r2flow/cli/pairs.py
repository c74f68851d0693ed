"""The verb for reflow pairs."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import choose_device
from r2flow.errors import InputError


@app.command(epilog="Example: torchrun --nproc-per-node 8 -m r2flow.cli pairs runs/r2flow_1rf --num 1000000")
def pairs(
    checkpoint: Annotated[Path, typer.Argument(help="The flow that draws them: a run folder or a checkpoint.")],
    num: Annotated[int, typer.Option(min=1, help="Pairs in all.")] = 1000,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Their folder; `pairs` in the run's if left out.")
    ] = None,
    solver: Annotated[str, typer.Option(help="dopri5, bosh3, euler, torchdiffeq:dopri5, ...")] = "dopri5",
    steps: Annotated[int, typer.Option(min=1, help="Of a fixed-step solver.")] = 32,
    tolerance: Annotated[float, typer.Option(help="Of an adaptive solver.")] = 1e-5,
    batch_size: Annotated[int, typer.Option(min=1, help="Pairs solved at once.")] = 16,
    shard_mib: Annotated[float, typer.Option(min=0.001, help="Size of a shard.")] = 256.0,
    seed: Annotated[int, typer.Option(min=0, help="Of their noise.")] = 0,
    first: Annotated[
        int | None, typer.Option(min=0, help="Index of the first pair; behind the flow's own pairs if left out.")
    ] = None,
    rank: Annotated[
        int | None, typer.Option(min=0, help="This process; read from torchrun or SLURM if left out.")
    ] = None,
    ranks: Annotated[int | None, typer.Option(min=1, help="Processes that share the work.")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1, ...")] = "auto",
) -> None:
    """Draw reflow pairs from a flow: what is missing or damaged, as one of any number of processes.

    `python train.py experiment=reflow stage.init=RUN` makes them itself; this makes them alone, under torchrun or as a
    SLURM array, with the settings of `data.pairs`.
    """
    from r2flow.checkpoints import load_checkpoint, weights_hash
    from r2flow.data.options import PairOptions
    from r2flow.data.pairs import default_folder
    from r2flow.data.shards import PairStore
    from r2flow.lineage import check_finished, pairs_of
    from r2flow.reports.pairs import make_and_tell, place

    found_rank, found_ranks, local = place()
    if (rank is None) != (ranks is None):
        raise InputError("--rank and --ranks belong together; give both or neither.")
    rank, ranks = (found_rank, found_ranks) if rank is None or ranks is None else (rank, ranks)
    if not 0 <= rank < ranks:
        raise InputError(
            f"process {rank} of {ranks}: they count from 0. Some elements of a SLURM array alone cannot be told from "
            "a smaller array; give --rank and --ranks."
        )
    where = choose_device(device)
    if where == "cuda" and found_ranks > 1:
        import torch

        where = f"cuda:{local % torch.cuda.device_count()}"  # SLURM may show each task one GPU alone
    flow = load_checkpoint(checkpoint)
    check_finished(checkpoint, flow)
    options = {
        "num": num, "method": solver, "steps": steps, "tolerance": tolerance, "batch_size": batch_size,
        "shard_mib": shard_mib, "seed": seed, "first": first,
    }  # fmt: skip
    recipe = PairOptions(**pairs_of(flow, options, weights_hash(flow))).recipe(
        flow.encoding.shape, flow.generator.noise_shape
    )
    store = PairStore(out or default_folder(flow.path), recipe)
    make_and_tell(store, flow, num, rank, ranks, where)
    lacking = len(store.missing(num))
    if lacking:
        print(f"{store.folder}: about {lacking * batch_size} of {num} pairs are other processes' and not there yet")
    else:
        size = sum(store.shard_path(shard).stat().st_size for shard in store.shards(num) if store.is_sealed(shard, num))
        print(f"{store.folder}: all {num} pairs, {len(store.shards(num))} shards, {size / 2**20:.0f} MiB")
