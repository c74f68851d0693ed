"""How near the backbones come to this machine's matrix products: the share of their rate that each
one reaches.

A share is (2 x MACs / time) over the rate of a plain matrix product of the same type, measured next
to it, so that it means the same on any machine and does not move with what else runs there. MACs by
the rule of r2flow/backbones/cost.py, three times as many for forward and backward. Medians, one
process.

python benchmarks/backbones.py                                  # forward and backward, eager, the
three base models python benchmarks/backbones.py --backbone hdit --mode compiled-bfloat16
python benchmarks/backbones.py --backbone hdit --mode float32 bfloat16 --threads 1 --profile  # and
where the time goes python benchmarks/backbones.py --experiment dusty2 --options data.batch_size=4
# a step of training, on simulated scans python benchmarks/backbones.py --device cuda --batch 1 8 64
--attention flex tiles --mode compiled-bfloat16
"""

import argparse
import json
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from typing import Any

import lightning as L
import torch

from r2flow.backbones import BACKBONES, Backbone
from r2flow.base.errors import InputError
from r2flow.lidar.sensors import build_sensor
from r2flow.reports.backbones import RULE, count_macs, count_parameters
from r2flow.training import build, compose, fit

MODES = (
    "float32",
    "bfloat16",
    "compiled-float32",
    "compiled-bfloat16",
    "training-float32",
    "training-bfloat16",
)
ORDER = {"cpu": 2048, "cuda": 8192}  # of the square matrices whose product sets the rate


def seconds(work: Callable[[], object], device: str) -> float:
    """Time of one call, to its end on the device."""
    start = time.perf_counter()
    work()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def built(config: str, rows: int, columns: int, attention: str, device: str) -> Backbone:
    """The backbone of a configuration on the paper's sensor; weights that start at zero are drawn
    instead.
    """
    options = BACKBONES.options(config)
    if options["name"] == "hdit":
        options["attention"] = attention
    torch.manual_seed(0)
    model = BACKBONES.build(options, build_sensor("hdl64e", rows, columns).rays())
    for parameter in model.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.02)
    return model.to(device)


def measured(
    model: Backbone, mode: str, batch: int, repeats: int, device: str, profile: bool = False
) -> dict[str, Any]:
    """Median milliseconds of one call and median share of the matrix product's rate timed beside
    it.

    With `profile` the share of its time of each operation too, by torch's profiler, of one more
    call.
    """
    kind, _, name = mode.rpartition("-")
    dtype = getattr(torch, name)
    x = torch.randn(batch, 2, *model.coords.shape[2:], device=device)
    t = torch.full((batch,), 0.5, device=device)
    square = torch.randn(2, ORDER[device], ORDER[device], device=device).to(dtype)
    call = torch.compile(model) if kind == "compiled" else model

    def work() -> None:
        with torch.autocast(device, dtype=torch.bfloat16, enabled=name == "bfloat16"):
            output = call(t, x)
        if kind == "training":
            model.zero_grad(set_to_none=True)
            output.square().mean().backward()

    def product() -> None:
        torch.mm(square[0], square[1])

    operations = 2 * count_macs(model) * batch * (3 if kind == "training" else 1)
    times, shares = [], []
    with torch.set_grad_enabled(kind == "training"):
        first = seconds(work, device)
        seconds(product, device)
        for _ in range(repeats):
            before = seconds(product, device)
            times.append(seconds(work, device))
            after = seconds(product, device)
            rate = 2 * 2 * ORDER[device] ** 3 / (before + after)
            shares.append(operations / times[-1] / rate)
        spent: dict[str, float] = {}
        if profile:
            with torch.profiler.profile() as seen:
                work()
            column = "self_device_time_total" if device == "cuda" else "self_cpu_time_total"
            spent = {one.key: getattr(one, column) for one in seen.key_averages()}
    if device == "cuda":
        memory = torch.cuda.max_memory_allocated() / 2**30
        torch.cuda.reset_peak_memory_stats()
    else:
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {
        "latency_ms": 1e3 * statistics.median(times),
        "share": statistics.median(shares),
        "first_call_s": first,
        "peak_gib": memory,
        "operations": {key: time / sum(spent.values()) for key, time in spent.items()},
    }


class Stopwatch(L.Callback):
    """Processor seconds of each step."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def on_train_batch_start(self, *_: Any) -> None:
        self.begin = time.process_time()

    def on_train_batch_end(self, *_: Any) -> None:
        self.seconds.append(time.process_time() - self.begin)


def trained(experiment: str, repeats: int, more: list[str]) -> dict[str, Any]:
    """Processor seconds of a step of an experiment as published but for its scans, and the
    process's peak memory.

    The first step, which warms up, is left out. Give one thread, and one experiment a process:
    memory is its peak.
    """
    with tempfile.TemporaryDirectory() as folder:
        options = [
            f"experiment={experiment}", "data=simulated", "data.scenes=8", "data.workers=0", "data.drives=null",
            "data.validation.data=null", "data.reading.projection=spherical",
            "data.reading.convention=centre",
            "trainer.accelerator=cpu", f"trainer.max_steps={repeats + 1}", f"trainer.val_check_interval={repeats + 1}",
            "trainer.enable_progress_bar=false", "callbacks.pictures=null", "samples.num=0", f"run_dir={folder}/run",
            *more,
        ]  # fmt: skip
        run, watch = build(compose(options)), Stopwatch()
        run.trainer.callbacks.insert(0, watch)
        fit(run)
    steps = watch.seconds[1:]
    return {
        "experiment": experiment, "batch": run.config.data.batch_size, "step_s": statistics.median(steps),
        "least_s": min(steps), "most_s": max(steps),
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }  # fmt: skip


def main() -> None:
    """Print the table, or the same as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backbone", nargs="+", default=["hdit", "efficient_unet", "adm_unet"])
    parser.add_argument("--experiment", help="time a step of this experiment's training instead")
    parser.add_argument(
        "--options", nargs="*", default=[], help="and these config keys, as data.batch_size=4"
    )
    parser.add_argument(
        "--mode", nargs="+", choices=MODES, default=["float32", "bfloat16", "training-float32"]
    )
    parser.add_argument(
        "--attention", nargs="+", default=["auto"], help="hdit's attention backends"
    )
    parser.add_argument("--batch", nargs="+", type=int, default=[1])
    parser.add_argument("--rows", type=int, default=64)
    parser.add_argument("--columns", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", choices=list(ORDER), default="cpu")
    parser.add_argument(
        "--profile", action="store_true", help="and where the time goes, by operation"
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.experiment:
        print(json.dumps(trained(options.experiment, options.repeats, options.options)))
        return
    found = []
    if not options.json:
        print(f"{RULE}\ntorch {torch.__version__}, {options.device}, {options.threads} threads")
        print(
            f"{'backbone':22s} {'mode':18s} {'attention':9s} batch {'ms':>9s} {'share':>6s} {'first s':>8s} peak GiB"
        )
    for config in options.backbone:
        for attention in options.attention:
            model = built(config, options.rows, options.columns, attention, options.device)
            for mode in options.mode:
                for batch in options.batch:
                    row = {"name": config, "mode": mode, "attention": attention, "batch": batch}
                    try:
                        model.train("training" in mode)
                        row |= measured(
                            model, mode, batch, options.repeats, options.device, options.profile
                        )
                    except InputError as error:
                        row["error"] = str(error)
                    row |= {"parameters": count_parameters(model), "gmac": count_macs(model) / 1e9}
                    found.append(row)
                    if not options.json:
                        print(line(row), flush=True)
                        spent = sorted(row.get("operations", {}).items(), key=lambda one: -one[1])
                        print(
                            "".join(f"    {share:6.1%}  {name}\n" for name, share in spent[:12]),
                            end="",
                            flush=True,
                        )
    if options.json:
        print(json.dumps(found, indent=2))


def line(row: dict[str, Any]) -> str:
    """One row of the table."""
    start = f"{row['name']:22s} {row['mode']:18s} {row['attention']:9s} {row['batch']:5d}"
    if "error" in row:
        return f"{start} {row['error']}"
    return f"{start} {row['latency_ms']:9.1f} {row['share']:6.1%} {row['first_call_s']:8.1f} {row['peak_gib']:8.2f}"


if __name__ == "__main__":
    main()
