"""LZF against streams made by hand."""

import pytest

from r2flow.lidar.scan_files import lzf

# Instructions by hand: 3 literals; a copy of 3 from 3 back; a copy of 7 + 2 + 3 = 12 from 1 back, which
# repeats its own output; 1 literal; a copy of 4 from 17 back, across the first byte's reach.
STREAM = bytes([2]) + b"abc" + bytes([1 << 5, 2]) + bytes([7 << 5, 3, 0]) + bytes([0]) + b"d"
STREAM += bytes([2 << 5, 16])
PLAIN = b"abcabc" + b"c" * 12 + b"d" + b"cabc"


def test_lzf_unpacks_a_stream_made_by_hand():
    assert lzf.decompress(STREAM, len(PLAIN)) == PLAIN


def test_lzf_reaches_8192_bytes_back_and_no_farther():
    far = bytes(range(256)) * 32
    literals = b"".join(bytes([31]) + far[k : k + 32] for k in range(0, len(far), 32))
    copy = bytes([1 << 5 | 31, 255])  # 3 bytes, the greatest distance
    assert lzf.decompress(literals + copy, 8195) == far + b"\x00\x01\x02"
    with pytest.raises(ValueError, match="before the beginning"):
        lzf.decompress(literals[33:] + copy, 8163)


@pytest.mark.parametrize(
    ("stream", "size"),
    [(STREAM[:-1], len(PLAIN)), (STREAM[:2], 3), (STREAM, len(PLAIN) + 1), (STREAM, 5), (b"\x20\x00", 3)],
)
def test_lzf_refuses_damaged_streams(stream, size):
    with pytest.raises(ValueError, match=r"end in the middle|do not unpack|before the beginning"):
        lzf.decompress(stream, size)
