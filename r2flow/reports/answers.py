"""Completion of scans to files: each is read, completed, written, drawn and counted."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from r2flow.base.progress import Bar
from r2flow.data.partial import PartialScan
from r2flow.generators import Sampler
from r2flow.lidar.other_sensors import Partial
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import Completed, complete
from r2flow.reports.answer_counts import Counts, print_counts
from r2flow.reports.answer_files import answer_files, check_inputs, write_answers
from r2flow.reports.answer_pictures import draw_answers
from r2flow.reports.answer_rays import Job, known_rays, measured_rays
from r2flow.reports.outputs import recipe_of
from r2flow.store import Store, manifest_of

if TYPE_CHECKING:
    from r2flow.reports.answer_errors import Compared, Errors

_THREADS = 4  # at most: Python's own work is done by one thread at a time


def write_completed(
    checkpoint: Checkpoint,
    scans: Sequence[PartialScan],
    out: Path,
    job: Job,
    sampler: Sampler,
    about: Mapping[str, Any],
) -> None:
    """Complete scans; write answers, their spread, pictures and 3-D pages; print counts.

    Scans whose answers are all in the folder are skipped. `about` has the other settings that
    affect the answers, as plain values.
    """
    settings = {
        "num": job.num,
        "fill_gaps": job.fill_gaps,
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
    counts = Counts()
    errors: dict[str, Errors] = {}
    batches = math.ceil(job.num / job.batch_size) * (sampler.evaluations(checkpoint.generator) or 0)
    bar = Bar("completing", len(left) * job.num, "answers", evaluations=len(left) * batches)

    def answer(number: int) -> tuple[Partial, Completed]:
        given = known_rays(scans[number], job, number)
        (completed,) = complete(
            checkpoint,
            torch.from_numpy(given.image)[None],
            torch.from_numpy(given.state)[None],
            job.num,
            job.seed,
            sampler=sampler,
            batch_size=job.batch_size,
            first=number,
            precision=job.precision,
            max_error=job.max_error,
            progress=bar.evaluated,
        )
        return given, completed

    def write(number: int, given: Partial, completed: Completed) -> tuple[Partial, Completed]:
        scan = scans[number]
        write_answers(checkpoint, scan, files[scan.name], given, completed, job)
        return given, completed

    with bar, _threads(checkpoint) as pool:
        done: Iterable[tuple[Partial, Completed]] = ()
        if left:
            first = answer(left[0])  # it shows that the settings are valid
            store.begin()  # commands for other scans add theirs at the same time
            before = manifest_of(out)
            scales = {scan.name: scan.scale for scan in scans}
            store.write_manifest(
                inputs={**before.get("inputs", {}), **inputs},
                reflectance_scales={**before.get("reflectance_scales", {}), **scales},
            )
            others = pool.map(lambda number: write(number, *answer(number)), left[1:])
            done = chain([write(left[0], *first)], others)
        for number, (given, completed) in zip(left, done, strict=True):
            scan = scans[number]
            beside: Compared | None = None
            if job.mask is not None and "range" not in job.hide:
                from r2flow.reports.answer_errors import compared, write_errors  # slow

                measured = measured_rays(scan, job)
                beside = compared(measured, given, completed, checkpoint.sensor)
                errors[scan.name] = beside.errors
                write_errors(out, {scan.name: beside.errors})
            if number < job.pictures:
                draw_answers(checkpoint.sensor, scan, out, given, completed, beside)
            counts.add(scan, given, completed)
        bar.set(len(left) * job.num)
    print_counts(checkpoint.sensor, counts)
    if errors:
        from r2flow.reports.answer_errors import COMPARE, in_words

        print(f"{in_words([*errors.values()])}; see {out / COMPARE}")
    written = f"{len(left)} scan{'' if len(left) == 1 else 's'} written to {out}"
    skipped = [f"{len(scans) - len(left)} there already"] if len(left) < len(scans) else []
    new = [f"{counts.added / len(left) / job.num:,.0f} new points a scan"] if left else []
    endings = {scan.ending: files[scan.name][0].suffix for scan in scans}
    other = [f"{own} as {given}" for own, given in endings.items() if own != given]
    print(", ".join([written, *skipped, *new, *other]))


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
