"""What kernels take on a GPU, read from a cubin: registers, memory on the stack, spills, and loads narrower than 32 bits.

Warp's own compiler writes cubins without a GPU. They are ELF files; registers and stack stand in the attributes of `.nv.info` (a list of
format, attribute, size and value), the instructions, of 16 bytes each since Volta, in a section `.text.NAME` for each kernel.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from kernels.device import CUDA_BLOCK

REGISTERS, FRAME = 0x2F, 0x11
"""Attributes of a kernel: registers of a thread, and bytes of its stack."""
VALUED = 4
"""Format of attributes whose value follows them."""
LOAD_LOCAL, STORE_LOCAL, LOAD_GLOBAL, NOTHING = 0x983, 0x387, 0x981, 0x918
"""Operation codes, the lowest 12 bits of an instruction."""
WIDTHS = 8, 8, 16, 16, 32, 64, 128, 128
"""Bits that a load moves, by bits 73 to 75 of its instruction."""


class Resources(NamedTuple):
    """The largest numbers among the kernels of a file."""

    registers: int
    stack: int  # bytes
    spills: int  # loads and stores of local memory
    narrow: int  # loads from global memory of less than 32 bits
    wide: int  # of 64 bits and more

    @property
    def warps(self) -> int:
        """Return how many warps of 32 threads a multiprocessor of 65536 registers holds at one time: whole blocks, 64 warps at most."""
        per_block = -(-self.registers // 8) * 8 * CUDA_BLOCK
        return min(65536 // per_block * CUDA_BLOCK, 2048) // 32


class Issued(NamedTuple):
    """How the instructions of a kernel follow each other."""

    instructions: int
    stalls: int
    """Cycles that pass after each before the next, in all."""


def _sections(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Yield the names of a file's sections with what is in them."""
    data = path.read_bytes()
    table, = struct.unpack_from("<Q", data, 0x28)
    size, count, names_at = struct.unpack_from("<HHH", data, 0x3A)
    headers = [struct.unpack_from("<IIQQQQIIQQ", data, table + k * size) for k in range(count)]
    bodies = [data[header[4] : header[4] + header[5]] for header in headers]
    for header, body in zip(headers, bodies, strict=True):
        yield bodies[names_at][header[0] :].split(b"\0", 1)[0], body


def issued(path: Path) -> Issued:
    """Return how the instructions of the longest kernel of a cubin follow each other."""
    kernels = [list(struct.iter_unpack("<QQ", body)) for name, body in _sections(path) if name.startswith(b".text.")]
    for codes in kernels:
        while codes and codes[-1][0] & 0xFFF == NOTHING:  # fills the section
            codes.pop()
    codes = max(kernels, key=len)
    return Issued(len(codes), sum(high >> 41 & 0xF for _, high in codes))


def resources(path: Path) -> Resources:
    """Return what the kernels of a cubin take."""
    found = []
    attributes: dict[int, int] = {REGISTERS: 0, FRAME: 0}
    for name, body in _sections(path):
        if name == b".nv.info":
            at = 0
            while at < len(body):
                kind, attribute, length = struct.unpack_from("<BBH", body, at)
                if kind == VALUED and attribute in attributes:
                    attributes[attribute] = max(attributes[attribute], struct.unpack_from("<I", body, at + 8)[0])
                at += 4 + (length if kind == VALUED else 0)
        elif name.startswith(b".text."):
            codes = list(struct.iter_unpack("<QQ", body))
            loads = [WIDTHS[high >> 9 & 7] for low, high in codes if low & 0xFFF == LOAD_GLOBAL]
            found.append((sum(low & 0xFFF in (LOAD_LOCAL, STORE_LOCAL) for low, _ in codes),
                          sum(width < 32 for width in loads), sum(width > 32 for width in loads)))
    return Resources(attributes[REGISTERS], attributes[FRAME], *map(max, zip(*found, strict=True)))
