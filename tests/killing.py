"""Processes that kill themselves at a moment that the test chooses, and waiting for others, not for
ever.
"""

import os
import signal
import time
import traceback
from collections.abc import Callable

import torch

from r2flow.base.errors import InputError

# The n-th rename, and whether the process dies before it or after it.
MOMENTS = [
    (1, True),
    (1, False),
    (2, True),
    (1, False),
    (1, True),
    (2, True),
    (1, False),
    (2, False),
]


def die_at(rename: int, before: bool) -> None:
    """From now on this process dies, by SIGKILL, at its `rename`-th file: before it has its name,
    or after.
    """
    replace, seen = os.replace, 0

    def dying(source: str, target: str) -> None:
        nonlocal seen
        seen += 1
        if seen == rename and before:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)
        if seen == rename:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = dying


def in_child(work: Callable[[], object]) -> int:
    child = os.fork()
    if child == 0:
        try:
            torch.set_num_threads(1)
            work()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    return child


def wait_until(there: Callable[[], bool], seconds: float = 60.0) -> None:
    begin = time.monotonic()
    while not there():
        assert time.monotonic() - begin < seconds, f"not there after {seconds} s"
        time.sleep(0.005)


def is_gone(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def be_killed(item: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def refuse(item: int) -> None:
    raise InputError("a worker refuses it")


def fail(item: int) -> None:
    error = ValueError("of the work")
    error.of = lambda: item  # type: ignore[attr-defined]  which cannot be pickled
    raise error


class Unreadable:
    def __reduce__(self):
        return refuse, (0,)  # when it is unpickled
