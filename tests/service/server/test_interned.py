"""The table of interned strings: that it is large enough before the service answers."""

import platform
import subprocess
import sys

import pytest

INTERNING = """
import ctypes, sys
from service.server.malloc import keep_freed_blocks, share_one_arena
share_one_arena()
keep_freed_blocks()
import service.server.serve
from service.server.interned import enlarge_interned

class Mallinfo2(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in
                "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()]

libc = ctypes.CDLL(None)
libc.mallinfo2.restype = Mallinfo2
if sys.argv[1] == "enlarged":
    enlarge_interned()
before = libc.mallinfo2()
for number in range(60_000):
    sys.intern(f"up_{number}.part")
after = libc.mallinfo2()
print(after.uordblks + after.hblkhd - before.uordblks - before.hblkhd)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc" or tuple(map(int, platform.libc_ver()[1].split("."))) < (2, 33),
                    reason="glibc says how much memory is in use from 2.33 on")
@pytest.mark.parametrize(("start", "grows"), [("enlarged", False), ("as it is", True)])
def test_names_of_thousands_of_uploads_make_no_table_larger(start, grows):
    done = subprocess.run([sys.executable, "-c", INTERNING, start], capture_output=True, text=True, check=True, timeout=120)
    assert (int(done.stdout) > 1 << 20) == grows
