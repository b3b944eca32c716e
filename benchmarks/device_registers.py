"""What the hottest kernels of more than 128 registers would win by being held to fewer: a section of docs/figures.md, from what
Warp's compiler makes of each, without a GPU."""

import tempfile
from math import ceil
from pathlib import Path

import warp as wp

from kernels.device import CUDA_BLOCK
from tests.kernels.cubin import Issued, Resources, issued, resources
from tests.kernels.test_cuda_builds import H100, HOT, KERNELS

BOUND = 128
"""Registers at which four blocks of CUDA_BLOCK threads share a multiprocessor."""
SCHEDULERS = 4
"""Schedulers of a multiprocessor, each of which issues an instruction a cycle."""


def cycles(issue: Issued, taken: Resources) -> int:
    """Return the cycles in which a scheduler issues each instruction of a kernel once for one warp, while others take turns with it."""
    return ceil(max(issue.instructions, issue.stalls / (taken.warps / SCHEDULERS)))


def compiled(name: str, blocks: int | None) -> tuple[Resources, Issued]:
    """Return what a kernel takes, held to registers of which so many blocks have enough; None: as it is."""
    module = KERNELS[name]().module
    kept = {kernel: dict(kernel.options) for kernel in module.kernels.values()}
    try:
        if blocks is not None:
            for kernel in kept:
                kernel.options["launch_bounds"] = CUDA_BLOCK, blocks
            module.mark_modified()
        with tempfile.TemporaryDirectory() as folder:
            wp.compile_aot_module(module, arch=H100, module_dir=folder, use_ptx=False)
            path, = Path(folder).glob("*.cubin")
            return resources(path), issued(path)
    finally:
        for kernel, options in kept.items():
            kernel.options.clear()
            kernel.options.update(options)
        module.mark_modified()


def register_rows() -> list[str]:
    """Return the section as lines of Markdown."""
    lines = [f"Kernels of `tests/kernels/cuda_resources.txt` with more than {BOUND} registers, compiled for sm_{H100} as they are, and by "
             f"launch bounds held to {BOUND}, of which four blocks of {CUDA_BLOCK} threads have enough. Not measured: read from the "
             "machine code. A multiprocessor has 65536 registers and four schedulers, which issue an instruction a cycle each; `stall` is "
             "the mean of the cycles that the compiler lets pass after an instruction before the next of the same warp (bits 105 to 108 "
             "of each; Jia and others, \"Dissecting the NVIDIA Volta GPU architecture via microbenchmarking\", 2018, section 2.1). A "
             "scheduler with w warps takes max(instructions, instructions · stall / w) cycles for each warp: more warps win nothing once "
             "w reaches the stall, and instructions that spill and reload only cost. Each instruction counts once, also in loops; waits "
             "for memory are left out, of which more warps hide more, and spills add some.", "",
             "| kernel | registers | warps | instructions | stall | cycles | held: warps | bytes of stack | spill instructions "
             "| instructions | stall | cycles | cycles, held over as they are |", "|" + "---|" * 13]
    for name, known in HOT.items():
        if known.registers > BOUND:
            (now, issue), (held, other) = compiled(name, None), compiled(name, 4)
            before, after = cycles(issue, now), cycles(other, held)
            lines.append(f"| `{name}` | {now.registers} | {now.warps} | {issue.instructions} | {issue.stalls / issue.instructions:.2f} | "
                         f"{before} | {held.warps} | {held.stack} | {held.spills} | {other.instructions} | "
                         f"{other.stalls / other.instructions:.2f} | {after} | {after / before:.3f} |")
    return lines
