"""Processes that make the items of a store, or of another object with `attempt` and `folder`."""

import logging
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Generator
from contextlib import suppress
from logging.handlers import QueueHandler
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any

from r2flow.base.errors import InputError
from r2flow.base.signals import blocking_signals, code_of, end_with_parent

_Work = Callable[[int], Any]


def attempts_of(
    store: Any, items: list[int], work: _Work, workers: int
) -> Generator[tuple[int, Any]]:
    """`store.attempt` of each item in `workers` processes (1: this one): items and results, as they
    come.

    Not by `concurrent.futures`, whose queues hold semaphores: a signal to the group of processes
    ends their tracker, and a worker that is stopped while it writes leaves them locked.
    """
    count = min(workers, len(items))
    if count <= 1:
        for item in items:
            yield item, store.attempt(item, work)
        return
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    processes = {}
    doing = {}
    left = iter(items)
    try:
        with blocking_signals():
            for _ in range(count):
                end, other = context.Pipe()
                process = context.Process(target=_serve, args=(other,))
                process.start()
                processes[end] = process
                other.close()  # so that the end of the process is noticed
        # Sent once, and not as an argument: Python waits forever if a process ends before it reads
        # a large one.
        for end, item in zip(processes, left, strict=False):
            doing[end] = item
            with suppress(OSError):  # noticed below
                end.send((store, work))
                end.send(item)
        while doing:
            for end in doing.keys() & wait(doing):
                result = _result(end, store.folder)
                if isinstance(result, logging.LogRecord):
                    logging.getLogger(result.name).handle(result)
                    continue
                item = doing.pop(end)
                following = next(left, None)
                if following is not None:
                    doing[end] = following
                    with suppress(OSError):
                        end.send(following)
                yield item, result
    finally:
        for end, process in processes.items():
            process.terminate()
            end.close()  # if compiled code of the process has swallowed the exception
        for process in processes.values():
            process.join()


def _result(end: Connection, folder: Path) -> Any:
    """The result of a process, or a line of its log; its errors are raised."""
    try:
        result = end.recv()
    except (EOFError, OSError):
        raise InputError(
            f"a process that wrote {folder} was killed or could not start; is there memory for as "
            "many processes? The same command resumes."
        ) from None
    if isinstance(result, Exception):
        raise result
    return result


def _serve(end: Connection) -> None:
    """Make items for the parent process until SIGTERM, or the end of the parent, which logs what
    this one would.
    """
    stopped = working = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        first = not stopped
        stopped = True
        if first and working:  # elsewhere an exception leaves a lock, or ends in `FileLock.__del__`
            raise SystemExit(code_of(number))

    def interruptible(item: int) -> Any:
        nonlocal working
        working = True
        try:
            if stopped:
                raise SystemExit(code_of(signal.SIGTERM))
            return work(item)
        finally:
            working = False

    end_with_parent(end=lambda: os.kill(os.getpid(), signal.SIGTERM))
    logging.getLogger().handlers = [QueueHandler(SimpleNamespace(put_nowait=end.send))]
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    with suppress(EOFError, OSError):  # the parent is gone
        try:
            store, work = end.recv()  # imports modules, and SIGTERM ends it at once
            signal.signal(signal.SIGTERM, stop)
            while True:
                end.send(store.attempt(end.recv(), interruptible))
        except Exception as error:
            error.add_note(traceback.format_exc())
            try:
                end.send(error)
            except Exception:  # it cannot be pickled
                end.send(RuntimeError(f"{type(error).__name__}: {error}"))
