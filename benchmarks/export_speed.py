"""Seconds a scan of an exported flow, beside the flow itself and its network compiled: medians,
taken in turns.

python benchmarks/export_speed.py street --sampler jump --steps 2 --repeats 7
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from copy import copy
from pathlib import Path

import torch

import r2flow
from r2flow.base.noise import Draws
from r2flow.model.export import compare, export


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flow")
    parser.add_argument(
        "--sampler", help="one that can be exported; the flow's for that many steps if left out"
    )
    parser.add_argument("--steps", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    loaded = r2flow.load(given.flow)
    flow = loaded.generator
    sampler = flow.choose(given.sampler, steps=given.steps)
    noise = Draws(0, [0]).start(flow.noise_shape)

    def drawn(generator: torch.nn.Module) -> Callable[[], object]:
        return lambda: flow.space.decode(generator(noise, sampler=sampler).x)

    ways = {"eager": drawn(flow)}
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        for kind in ("onnx", "pt2"):
            start = time.perf_counter()
            written = export(loaded, Path(folder, f"flow.{kind}"), sampler)
            print(
                f"{kind}: written in {time.perf_counter() - start:.0f} s, "
                f"{compare(loaded, written, sampler)}",
                flush=True,
            )
            ways[kind] = runner(written.path, noise)
        compiled = copy(flow)
        compiled._modules = {"backbone": torch.compile(flow.backbone)}
        ways["compiled"] = drawn(compiled)
        for way in ways.values():
            way()
        taken: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(given.repeats):
            for name, way in ways.items():
                start = time.perf_counter()
                way()
                taken[name].append(time.perf_counter() - start)
    eager = statistics.median(taken["eager"])
    for name, seconds in taken.items():
        middle = statistics.median(seconds)
        print(f"{name:9} {1000 * middle:8.1f} ms a scan, {middle / eager:.2f} of eager")


def runner(path: Path, noise: torch.Tensor) -> Callable[[], object]:
    """What draws a scan by an exported file that is open."""
    if path.suffix == ".pt2":
        program = torch.export.load(path).module()
        return lambda: program(noise)
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return lambda: session.run(None, {"noise": noise.numpy()})


if __name__ == "__main__":
    main()
