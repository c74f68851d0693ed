"""Freed memory stays with the process, unless the user has said otherwise."""

import os
import platform
import subprocess
import sys

import pytest

BLOCK, TIMES = 64 << 20, 8
PROGRAM = f"""
import ctypes, resource
from r2flow.memory import prepare_process

prepare_process()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
libc.memset.argtypes, libc.free.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t], [ctypes.c_void_p]
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range({TIMES}):
    block = libc.malloc({BLOCK})
    libc.memset(block, 1, {BLOCK})
    libc.free(block)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def new_pages(**settings: str) -> int:
    """Pages that the kernel had to give for a block that is taken and freed again and again."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")} | settings
    return int(
        subprocess.run([sys.executable, "-c", PROGRAM], env=own, capture_output=True, check=True, text=True).stdout
    )


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_a_freed_block_is_used_again_without_new_pages():
    once = BLOCK // os.sysconf("SC_PAGE_SIZE")
    if new_pages(MALLOC_MMAP_THRESHOLD_="131072") < TIMES * once:
        pytest.skip("the kernel gives larger pages than it says")
    assert new_pages() < 1.1 * once
