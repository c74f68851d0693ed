"""Memory of the C library."""

import ctypes
import os
import sys

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h
LARGEST, KEPT = 1 << 30, 2**31 - 1  # bytes


def keep_freed_memory() -> None:
    """Keep freed memory for the next tensor, where the C library is glibc.

    Without it glibc gives each freed block of 32 MiB or more back, and the kernel clears new pages for the next one.
    Now blocks of up to 1 GiB come from the heap, of which up to 2 GiB stay. What the user has set (MALLOC_MMAP_...,
    MALLOC_TRIM_..., see `man mallopt`) stays as it is, and so does a glibc that refuses so large a block.
    """
    if sys.platform != "linux" or any(name.startswith(("MALLOC_MMAP_", "MALLOC_TRIM_")) for name in os.environ):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
    if mallopt is not None and mallopt(M_MMAP_THRESHOLD, LARGEST):
        mallopt(M_TRIM_THRESHOLD, KEPT)
