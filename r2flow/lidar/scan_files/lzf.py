"""LZF, the compression inside PCD's `binary_compressed`.

A stream is a sequence of two instructions. A control byte below 32 announces control + 1 literal
bytes. Any other copies what was written before: its upper three bits hold length - 2, where 7 means that
one more byte is to be added; its lower five bits and the next byte hold distance - 1. A copy may
overlap its own output, which repeats a pattern.

Pure Python, because the bindings to liblzf come without wheels; the loops run over instructions, not
over bytes, so that a scan takes a fraction of a second.
"""

import numpy as np

LONGEST_LITERAL = 32
LONGEST_COPY = 264
FARTHEST_COPY = 8192


def decompress(stream: bytes, size: int) -> bytes:
    """The `size` bytes that `stream` stands for.

    Raises:
        ValueError: the stream is cut, refers to before its beginning, or does not give `size` bytes.
    """
    output = bytearray()
    position, end = 0, len(stream)
    try:
        while position < end and len(output) <= size:
            control = stream[position]
            if control < LONGEST_LITERAL:
                literal = stream[position + 1 : position + 2 + control]
                if len(literal) != control + 1:
                    raise IndexError
                output += literal
                position += 2 + control
                continue
            length = (control >> 5) + 2
            if length == 9:
                position += 1
                length += stream[position]
            distance = ((control & 31) << 8 | stream[position + 1]) + 1
            position += 2
            start = len(output) - distance
            if start < 0:
                raise ValueError("a copy refers to before the beginning")
            pattern = output[start : start + length]
            output += pattern if distance >= length else (pattern * (length // distance + 1))[:length]
    except IndexError:
        raise ValueError("the compressed data end in the middle of an instruction") from None
    if len(output) != size or position < end:
        raise ValueError(f"the data do not unpack to the declared {size} bytes")
    return bytes(output)


def compress(data: bytes) -> bytes:
    """An LZF stream for `data`, at most a 32nd longer than it; greedy, copying from the latest match."""
    output = bytearray()
    done = 0
    earlier = _earlier_matches(data)
    where = np.flatnonzero(earlier >= 0)
    for position, source in zip(where.tolist(), earlier[where].tolist(), strict=True):
        if position < done:
            continue
        longest = min(LONGEST_COPY, len(data) - position)
        length = 3
        while length < longest and data[source + length] == data[position + length]:
            length += 1
        _add_literals(output, data[done:position])
        _add_copy(output, position - source, length)
        done = position + length
    _add_literals(output, data[done:])
    return bytes(output)


def _earlier_matches(data: bytes) -> np.ndarray:
    """For each byte, the latest earlier place within reach where the same three bytes begin, or -1."""
    raw = np.frombuffer(data, dtype=np.uint8).astype(np.uint32)
    if len(raw) < 3:
        return np.empty(0, dtype=np.int64)
    triple = raw[:-2] | raw[1:-1] << 8 | raw[2:] << 16
    order = np.argsort(triple, kind="stable")  # equal triples in a row, in order of place
    near = (triple[order[1:]] == triple[order[:-1]]) & (np.diff(order) <= FARTHEST_COPY)
    earlier = np.full(len(triple), -1)
    earlier[order[1:][near]] = order[:-1][near]
    return earlier


def _add_literals(output: bytearray, literals: bytes) -> None:
    for start in range(0, len(literals), LONGEST_LITERAL):
        run = literals[start : start + LONGEST_LITERAL]
        output.append(len(run) - 1)
        output += run


def _add_copy(output: bytearray, distance: int, length: int) -> None:
    high, low = divmod(distance - 1, 256)
    if length < 9:
        output += bytes([(length - 2) << 5 | high, low])
    else:
        output += bytes([7 << 5 | high, length - 9, low])
