"""LZF, the compression inside PCD's `binary_compressed`: unpacking.

A stream is a sequence of two instructions. A control byte below 32 announces control + 1 literal bytes. Any other
copies what was written before: its upper three bits hold length - 2, where 7 means that one more byte is to be added;
its lower five bits and the next byte hold distance - 1. A copy may overlap its own output, which repeats a pattern.

Pure Python, because the bindings to liblzf come without wheels; the loop runs over instructions, not over bytes, so
that a scan takes a fraction of a second.
"""


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
            if control < 32:
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
