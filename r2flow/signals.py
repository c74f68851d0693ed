"""Being told to stop: what a signal means to a run, and to a process that waits for one."""

import atexit
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

Handler = Callable[[int, FrameType | None], None] | signal.Handlers

STOPPING = (signal.SIGTERM, signal.SIGINT)

LATER = 75  # exit code, "try again later" among the system's: the run is not at its end, the same command resumes


class Stopped(BaseException):
    """The work was told to stop, and has.

    Not an `Exception`: what deals with errors on the way (a reader's, Hydra's) must not take it for one.

    Attributes:
        code: What the process is to exit with: 143 after SIGTERM, 130 after Ctrl-C.
    """

    def __init__(self, code: int, said: str = "stopped") -> None:
        super().__init__(said)
        self.code = code


def code_of(number: int) -> int:
    """The exit code by which a shell knows that a signal ended a process."""
    return 128 + number


def outlive_parent(seconds: float = 10.0) -> None:
    """Wait for the launching process: Lightning kills it, unheard, once a child has ended with another code than 0."""
    parent, begin = os.getppid(), time.monotonic()
    while os.getppid() == parent and time.monotonic() - begin < seconds:
        time.sleep(0.1)


@contextmanager
def listening(handler: Handler, signals: Sequence[int] = STOPPING) -> Iterator[None]:
    """Have signals handled for the length of a block. Outside the main thread, which alone hears them, nothing changes.

    Ctrl-C stays ignored where it is: a shell's background job is not meant.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {one: signal.getsignal(one) for one in signals}
    heard = [one for one in signals if not (one == signal.SIGINT and before[one] is signal.SIG_IGN)]
    for one in heard:
        signal.signal(one, handler)
    try:
        yield
    finally:
        for one in heard:
            signal.signal(one, before[one])


def stop_at_once(number: int, frame: FrameType | None = None) -> None:
    """A handler: nothing is under way that would have to be saved."""
    if multiprocessing.parent_process() is not None:  # a worker, forked with the handler: who started it speaks
        os._exit(code_of(number))
    if _is_importing(frame):  # compiled modules swallow an exception, or make another one of it
        end_at_once(number)
    raise Stopped(code_of(number))


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


def end_at_once(number: int, frame: FrameType | None = None) -> None:
    """A handler for a program that is still being imported, or ends: there is nothing to clear away."""
    os.write(2, b"stopped\n")
    os._exit(code_of(number))


@contextmanager
def heard_from_the_first_import() -> Iterator[None]:
    """Answer Ctrl-C and SIGTERM in one line around a whole program, whose imports take seconds, and at its exit."""
    atexit.register(_end_in_peace)  # first, so that it is called last
    with listening(end_at_once):
        try:
            yield
        finally:
            atexit.unregister(_hear_at_exit)
            atexit.register(_hear_at_exit)  # last, so that it is called first


def _end_in_peace() -> None:
    """Ignore signals while the interpreter takes itself apart, handlers too: the program has ended already."""
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)


def _hear_at_exit() -> None:
    for number in STOPPING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end_at_once)


def end_with_parent(worker: int = 0) -> None:
    """In a worker: end when the process that started it has ended, in whatever way.

    A worker that waits for the reader of its results, which is gone, would wait for ever.
    """

    def wait() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def out_of_reach() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach, not even as they import; here it waits for the end of the block."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # which they inherit
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def outlive_the_signal(worker: int = 0) -> None:
    """In a loader's worker: a signal is for the run, which may need the worker for the step that it is in.

    A worker that its run has forgotten goes by itself, and with its run.
    """
    end_with_parent()

    def hear(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(30)

    if os.name == "posix":
        for number in STOPPING:
            signal.signal(number, hear)
