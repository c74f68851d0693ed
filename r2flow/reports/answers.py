"""Completion of scans to files: each is read, completed, written, drawn and counted."""

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from r2flow.base.progress import Bar
from r2flow.data.partial import PartialScan
from r2flow.generators import Sampler
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import complete
from r2flow.reports.answer_counts import Counts, and_more
from r2flow.reports.answer_files import answer_files, check_inputs, write_answers
from r2flow.reports.answer_pictures import draw_answers
from r2flow.reports.answer_rays import Answered, Job, known_rays, measured_rays
from r2flow.reports.outputs import recipe_of
from r2flow.store import Store, manifest_of

if TYPE_CHECKING:
    from r2flow.reports.answer_errors import Compared

_THREADS = 4  # at most: Python's own work is done by one thread at a time


def write_completed(
    checkpoint: Checkpoint,
    scans: Sequence[PartialScan],
    out: Path,
    job: Job,
    sampler: Sampler,
    about: Mapping[str, Any],
) -> list[str]:
    """Complete scans; write answers, their spread, pictures and 3-D pages; returns lines on them.

    Scans whose answers are all in the folder are skipped. `about` has the other settings that
    affect the answers, as plain values.
    """
    settings = {
        "num": job.num,
        **about,
        "precision": job.precision,
        "max_error": job.max_error,
        "hide": sorted(job.hide) or None,
    }
    recipe = recipe_of(checkpoint, job.seed, sampler, job.label_ids, completion=settings)
    store = Store(out, "answers", recipe)
    files = {scan.name: answer_files(scan, out, job.num) for scan in scans}
    inputs = check_inputs(store, scans, files)
    left = [
        number
        for number, scan in enumerate(scans)
        if not all(path.is_file() for path in files[scan.name])
    ]
    evaluations = math.ceil(job.num / job.batch_size) * (
        sampler.evaluations(checkpoint.generator) or 0
    )
    bar = Bar("completing", len(left) * job.num, "answers", evaluations=len(left) * evaluations)
    completer = _Completer(checkpoint, scans, files, job, sampler, bar)
    counts = Counts()
    beside: dict[str, Compared] = {}
    with bar:
        for answered in completer.completed(left, store, inputs):
            name = answered.scan.name
            if job.mask is not None and "range" not in job.hide:
                from r2flow.reports.answer_errors import compared, write_errors  # slow

                measured = measured_rays(answered.scan, job)
                beside[name] = compared(measured, answered, checkpoint.sensor, job.max_error)
                write_errors(out, {name: beside[name]})
            if answered.number < job.pictures:
                draw_answers(checkpoint.sensor, answered, out, beside.get(name))
            counts.add(answered)
        bar.set(len(left) * job.num)
    lines = counts.lines(checkpoint)
    if beside:
        from r2flow.reports.answer_errors import COMPARE, in_words

        lines.append(f"{in_words([*beside.values()])}; see {out / COMPARE}")
    written = [f"{len(left)} scan{'' if len(left) == 1 else 's'} written to {out}"]
    if len(left) < len(scans):
        written.append(f"{len(scans) - len(left)} there already")
    if left:
        written.append(f"{counts.added / len(left) / job.num:,.0f} new points a scan")
    endings = {scan.ending: files[scan.name][0].suffix for scan in scans}
    written += [f"{one} as {other}" for one, other in endings.items() if not one.endswith(other)]
    lines.append(", ".join(written))
    drawn = [out / f"{scans[number].name}.png" for number in left if number < job.pictures]
    if drawn:
        lines.append(f"pictures in {and_more(drawn)}, in 3-D in {drawn[0].with_suffix('.html')}")
    return lines


@dataclass(frozen=True)
class _Completer:
    """Completes scans and writes their answers, several at once."""

    checkpoint: Checkpoint
    scans: Sequence[PartialScan]
    files: Mapping[str, Sequence[Path]]  # by name
    job: Job
    sampler: Sampler
    bar: Bar

    def completed(
        self, numbers: Sequence[int], store: Store, inputs: Mapping[str, str]
    ) -> Iterator[Answered]:
        """Complete some scans in order; the first shows that the settings are valid."""
        if not numbers:
            return
        first = self.answer(numbers[0])
        store.begin()  # commands for other scans add theirs at the same time
        before = manifest_of(store.folder)
        scales = {scan.name: scan.scale for scan in self.scans}
        store.write_manifest(
            inputs={**before.get("inputs", {}), **inputs},
            reflectance_scales={**before.get("reflectance_scales", {}), **scales},
        )
        with _threads(self.checkpoint) as pool:
            others = pool.map(lambda number: self.write(self.answer(number)), numbers[1:])
            yield self.write(first)
            yield from others

    def answer(self, number: int) -> Answered:
        scan, job = self.scans[number], self.job
        known = known_rays(scan, job, number)
        (completed,) = complete(
            self.checkpoint,
            torch.from_numpy(known.image)[None],
            torch.from_numpy(known.state)[None],
            job.num,
            job.seed,
            sampler=self.sampler,
            batch_size=job.batch_size,
            first=number,
            precision=job.precision,
            max_error=job.max_error,
            progress=self.bar.evaluated,
        )
        return Answered(number, scan, known, completed)

    def write(self, answered: Answered) -> Answered:
        write_answers(self.checkpoint, answered, self.files[answered.scan.name], self.job)
        return answered


@contextmanager
def _threads(checkpoint: Checkpoint) -> Iterator[ThreadPoolExecutor]:
    """Threads that read, complete and write a scan each: on a CPU they share its cores.

    A command that is stopped does not wait for the scans that are left.
    """
    cores = torch.get_num_threads()
    count = min(cores, _THREADS) if checkpoint.generator.device.type == "cpu" else _THREADS
    pool = ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(cores // count,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
