"""The verb for reflow pairs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import SamplerOptions, grouped
from r2flow.cli.options import DeviceOption, PrecisionOption, choose_device
from r2flow.errors import InputError


@dataclass(frozen=True)
class ShareOptions:
    """Which part of the work is this process's."""

    rank: Annotated[int | None, typer.Option(min=0, help="This process; read from torchrun or SLURM if left out.")] = (
        None
    )
    ranks: Annotated[int | None, typer.Option(min=1, help="Processes that share the work.")] = None
    device: DeviceOption = "auto"

    def place(self) -> tuple[int, int, str]:
        """Rank, processes and device.

        Raises:
            InputError: one of --rank and --ranks, or a rank that is not below --ranks.
        """
        from r2flow.reports.pairs import place

        rank, ranks, local = place()
        where = choose_device(self.device)
        if where == "cuda" and ranks > 1:
            import torch

            where = f"cuda:{local % torch.cuda.device_count()}"  # SLURM may show each task one GPU alone
        if (self.rank is None) != (self.ranks is None):
            raise InputError("--rank and --ranks belong together; give both or neither.")
        if self.rank is not None and self.ranks is not None:
            rank, ranks = self.rank, self.ranks
        if not 0 <= rank < ranks:
            raise InputError(
                f"process {rank} of {ranks}: they count from 0. Some elements of a SLURM array alone cannot be told "
                "from a smaller array; give --rank and --ranks."
            )
        return rank, ranks, where


@app.command(epilog="Example: torchrun --nproc-per-node 8 -m r2flow.cli pairs runs/r2flow_1rf --num 1000000")
@grouped
def pairs(
    model: Annotated[str, typer.Argument(help="A model, a run folder or a checkpoint file.", show_default=False)],
    how: SamplerOptions,
    share: ShareOptions,
    num: Annotated[int, typer.Option(min=1, help="Pairs in all.")] = 1000,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Their folder; `pairs` in the run's if left out.")
    ] = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Pairs solved at once.")] = 16,
    shard_mib: Annotated[float, typer.Option(min=0.001, help="Size of a shard.")] = 16.0,
    seed: Annotated[int, typer.Option(min=0, help="Of their noise.")] = 0,
    first: Annotated[
        int | None, typer.Option(min=0, help="Index of the first pair; behind the flow's own pairs if left out.")
    ] = None,
    precision: PrecisionOption = "32-true",
    knots: Annotated[int | None, typer.Option(min=1, help="Inner states to keep of each path, for a flow map.")] = None,
) -> None:
    """Draw reflow pairs from a flow: what is missing or damaged, as one of any number of processes.

    `python train.py experiment=reflow stage.init=RUN` makes them itself; this makes them alone, under torchrun or as a
    SLURM array, with the settings of `data.pairs`. The sampler is adams3 in 32 steps if left out;
    --sampler dopri5 is the paper's; chord or renoise gives a flow map's first jump as its later ones correct it.
    """
    from r2flow.data.options import PairOptions
    from r2flow.data.pairs import PairStore, default_folder
    from r2flow.model.checkpoint import load_checkpoint, weights_hash
    from r2flow.reports.pairs import make_and_tell
    from r2flow.runs.lineage import check_finished, pairs_of

    rank, ranks, where = share.place()
    flow = load_checkpoint(model)
    check_finished(Path(model), flow)
    options = {
        "sampler": {"name": "adams3", **how.given}, "precision": precision,
        "num": num, "batch_size": batch_size, "shard_mib": shard_mib, "seed": seed, "first": first,
        "knots": knots,
    }  # fmt: skip
    recipe = PairOptions(**pairs_of(flow, options, weights_hash(flow))).recipe(
        flow.encoding.shape, flow.generator.noise_shape
    )
    store = PairStore(out or default_folder(flow.path), recipe)
    make_and_tell(store, flow, num, rank, ranks, where)
    lacking = store.missing_pairs(num)
    if lacking:
        print(f"{store.folder}: other processes have still to make about {lacking} of {num} pairs")
    else:
        shards = store.shards(num)
        size = sum(store.files(shard)[0].stat().st_size for shard in shards)
        print(f"{store.folder}: all {num} pairs, {len(shards)} shard{'s' * (len(shards) != 1)}, {size / 2**20:.0f} MiB")
