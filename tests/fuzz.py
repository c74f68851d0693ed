"""A child process that reads damaged files under a memory limit and an alarm; see test_fuzzing.py.

Each line that it prints is one file that was read otherwise than it should be, or the end of one
kind of file.
"""

import json
import logging
import resource
import signal
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

MEMORY = 6 << 30  # bytes of address space
PATIENCE = 20  # seconds a file
# bytes that a reader may take besides four times its file: buffers, and what it imports
SPARE = 96 << 20


class TooLong(BaseException):
    """Reading took longer than it may."""


def damaged(content: bytes, draw: np.random.Generator) -> bytes:
    """Flipped bits, a cut, an insertion, an overwritten stretch, or large and negative numbers in
    the header.
    """
    data, kind = bytearray(content), draw.integers(7)
    if kind in (0, 5):  # anywhere, and in the first bytes, where headers are
        size = len(data) if kind == 0 else min(len(data), 256)
        for bit in draw.integers(0, 8 * size, draw.integers(1, 5)):
            data[bit // 8] ^= 1 << bit % 8
    elif kind == 1:
        del data[draw.integers(len(data)) :]
    elif kind == 2:
        place = int(draw.integers(len(data) + 1))
        data[place:place] = draw.bytes(int(draw.integers(1, 64)))
    elif kind == 3:
        first, last = sorted(draw.integers(0, len(data), 2).tolist())
        data[first:last] = [
            bytes(last - first),
            draw.bytes(last - first),
            b"\xff" * (last - first),
        ][draw.integers(3)]
    elif kind == 4:
        place = int(draw.integers(min(len(data), 512)))
        data[place : place + 8] = [b"\xff" * 8, b"\x00" * 8, b"99999999", b"-1      ", b"[[[[[[[["][
            draw.integers(5)
        ]
    else:
        digits = [place for place, byte in enumerate(data[:4096]) if 48 <= byte < 58]
        if digits:
            place = digits[draw.integers(len(digits))]
            data[place : place + 1] = b"9" * int(draw.integers(1, 20))
    return bytes(data)


def peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )


def too_long(*_: object) -> None:
    raise TooLong


def finding(read: Callable[[Path], object], path: Path, whole: object) -> tuple[bool, str | None]:
    from r2flow.base.errors import InputError

    signal.alarm(PATIENCE)
    try:
        found = read(path)
        other = isinstance(whole, bytes) and isinstance(found, bytes) and found != whole
        return True, "other content under a checksum" if other else None
    except InputError as error:
        return False, f"several lines: {str(error)[:200]}" if "\n" in str(error).strip() else None
    except TooLong:
        return False, "hangs"
    except BaseException as error:
        where = "".join(traceback.format_tb(error.__traceback__)[-2:])
        return False, f"{type(error).__name__}: {str(error)[:200]} {where}"
    finally:
        signal.alarm(0)


def main(folder: Path, seed: int, count: int) -> None:
    from tests.fuzzing_readers import READERS

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, too_long)
    for original in sorted(path for kind in READERS for path in (folder / kind).glob("*")):
        read, content = READERS[original.parent.name], original.read_bytes()
        target = folder / "damaged" / original.parent.name / original.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
        whole = read(target)
        draw = np.random.default_rng([seed, sum(original.name.encode()), len(content)])
        times_read = 0
        for number in range(count):
            data = damaged(content, draw)
            target.write_bytes(data)
            before = peak()
            is_read, wrong = finding(read, target, whole)
            times_read += is_read and data != content
            grown = peak() - before
            if grown > 4 * len(data) + SPARE:
                wrong = f"{len(data)} bytes take {grown >> 20} MiB; {wrong}"
            if wrong:
                print(
                    json.dumps([f"{original.parent.name}/{original.name}", number, wrong]),
                    flush=True,
                )
        target.write_bytes(content)
        read(target)  # where files lie beside each other, the next one is damaged alone
        print(
            json.dumps(["done", f"{original.parent.name}/{original.name}", count, times_read]),
            flush=True,
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
