"""Handling of stop signals in runs, launchers and workers."""

import atexit
import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any

_Handler = Callable[[int, FrameType | None], object] | signal.Handlers

STOPPING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

LATER = 75  # exit code EX_TEMPFAIL of an unfinished run: the same command resumes

# After torch's shutdown and before multiprocessing's SIGTERM, which workers of a failed run's
# loader outlive for 30 s:
atexit.register(lambda: [one.kill() for one in multiprocessing.active_children() if one.daemon])  # type: ignore[func-returns-value]
atexit.register(signal.signal, signal.SIGCHLD, signal.SIG_DFL)  # torch's handler would report them


class Stopped(BaseException):
    """Work was stopped by a signal; `code` is the exit code of the process, as 130 after Ctrl-C:
    `code_of`.

    Not an `Exception`, so that handlers of errors (in readers, in Hydra) do not catch it.
    """

    def __init__(self, code: int, message: str = "stopped") -> None:
        super().__init__(message)
        self.code = code


def code_of(number: int) -> int:
    """Exit code of a process that ended by a signal, as in shells."""
    return 128 + number


def wait_for_launcher(seconds: float = 10.0) -> None:
    """Wait for the end of the launching process, which Lightning kills once a child ends with a
    nonzero code.
    """
    parent = os.getppid()
    end = time.monotonic() + seconds
    while os.getppid() == parent and time.monotonic() < end:
        time.sleep(0.1)


def install_handlers(handler: _Handler, signals: Sequence[int] = STOPPING) -> dict[int, Any]:
    """Handle signals, and return their former handlers.

    Stop signals stay ignored if they were, as Ctrl-C in background jobs of a shell and SIGHUP under
    nohup.
    """
    heard = [n for n in signals if n not in STOPPING or signal.getsignal(n) is not signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in heard}


@contextmanager
def handling_signals(handler: _Handler, signals: Sequence[int] = STOPPING) -> Iterator[None]:
    """Handle signals within a block as `install_handlers`; without effect outside the main thread,
    which alone receives them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = install_handlers(handler, signals)
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


def stop_at_once(number: int, frame: FrameType | None = None) -> None:
    """_Handler without anything to save."""
    # a forked worker; its parent prints the message
    if multiprocessing.parent_process() is not None:
        os._exit(code_of(number))
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    if frame is not None:  # within an import, whose compiled modules swallow or replace exceptions
        _end_at_once(number)
    raise Stopped(code_of(number))


def _end_at_once(number: int, frame: FrameType | None = None) -> None:
    """_Handler during imports and at exit, without cleanup."""
    os.write(2, b"stopped\n")
    os._exit(code_of(number))


@contextmanager
def handling_signals_of_program() -> Iterator[None]:
    """Answer stop signals by one line during a whole program, its imports and its exit."""
    # Registered first, so that it is called last.
    atexit.register(partial(install_handlers, signal.SIG_IGN))
    with handling_signals(_end_at_once):
        try:
            yield
        finally:
            atexit.unregister(install_handlers)
            # Registered last, so that it is called first.
            atexit.register(install_handlers, _end_at_once)


def end_with_parent(end: Callable[[], object] = lambda: os._exit(1)) -> None:
    """End a worker when its parent process ends, since it would wait forever for a reader of its
    results.
    """

    def wait() -> None:
        if parent := multiprocessing.parent_process():
            parent.join()
            end()

    threading.Thread(target=wait, daemon=True).start()


def stop_with_torchrun() -> None:
    """Receive SIGTERM when torchrun's agent ends, also if it was killed."""
    if sys.platform == "linux" and "TORCHELASTIC_RUN_ID" in os.environ:
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


@contextmanager
def blocking_signals() -> Iterator[None]:
    """Start processes that block stop signals; this process hears them after the block."""
    heard: list[int] = []
    resource_tracker.ensure_running()  # which unblocks signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)  # also in the processes
    try:
        with handling_signals(lambda number, frame: heard.append(number)):  # in other threads
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if heard:
            signal.raise_signal(heard[0])


def init_loader_worker(worker: int = 0) -> None:
    """Keep a loader's worker alive for 30 s after a signal, since its run may need it; it also ends
    with its run.
    """
    end_with_parent()
    sys.excepthook = lambda *_: None  # called if a stopped run drops the connection for a tensor
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    install_handlers(lambda number, frame: signal.alarm(30))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)  # blocked if started `blocking_signals`


def run_process(command: Sequence[str]) -> int:
    """Run a command, forward stop signals to it, and end it with this process; its exit code is
    that of a shell.
    """
    received: list[int] = []

    def pass_on(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if process is not None and process.poll() is None:
            process.send_signal(number)

    process: subprocess.Popen[bytes] | None = None
    with handling_signals(pass_on):
        # PR_SET_PDEATHSIG: a run that outlived its sweep would block the same command when given
        # again.
        linux = sys.platform == "linux"
        end = partial(ctypes.CDLL(None).prctl, 1, signal.SIGKILL) if linux else None
        process = subprocess.Popen(command, preexec_fn=end)
        if received:
            process.send_signal(received[0])
        code = process.wait() or -next(iter(received), 0)
    return code_of(-code) if code < 0 else code
