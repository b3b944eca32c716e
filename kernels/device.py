"""Device choice, pack width, and splitting a launch over CPU threads.

On the CPU a Warp launch runs its threads one after another on one core and releases the GIL while it does, so a launch is
cut into blocks that a thread pool runs side by side. On CUDA a launch is one launch.
"""

import itertools
import os
import platform
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
import warp as wp

from kernels.errors import ArrayError, DeviceError

wp.config.log_level = wp.LOG_ERROR  # the caller reports the device; compiling shows as progress, not as lines
wp.config.cuda_output = "cubin"  # else the driver compiles, and its version decides the last bits
wp.config.default_grid_stride = False  # on CUDA a loop over further indices, of which a thread has none, takes up to 75 registers
wp.config.enable_backward = False  # nothing is differentiated, and a backward pass takes longer to compile than the kernel

PACK_CPU = 32
"""Pixels per thread on the CPU: wide enough for the compiler to fill SIMD registers (docs/figures.md)."""
PACK_CUDA = 4
"""Pixels per thread on CUDA: one 8-byte load of half values per thread, coalesced over a warp."""
LANES_CUDA = 1
"""Pixels per thread on CUDA of kernels with dozens of sums for a pixel, which stay in registers; on the CPU a thread takes a whole pack."""
UNEVEN_BLOCKS = 4
"""CPU blocks per core where some take longer than others. Where all take the same, one a core: starting a block takes a tenth of a
millisecond of the interpreter, during which the other cores wait."""

CPU_BLOCK = 1
"""The block size that Warp launches CPU kernels with; loading ahead with another would compile the module twice."""

CUDA_BLOCK = 128
"""Threads of a CUDA block. A multiprocessor has 65536 registers: three blocks of a kernel with 168 fit, 12 warps. Of 256 threads only one
would, 8 warps. Kernels of more than 128 registers are not held to 128, at which four blocks fit: by launch bounds,
the five that obey them would spill and reload registers 26 to 176 times, for a third more warps."""
MAX_THREADS = 2**31 - 1
"""Largest number of threads of one launch: kernels count threads in 32 bits."""

MOST_BATCH_BYTES = 4 * 2**31
"""Largest batch: kernels count its float32 values in 32 bits."""

CUDA_PIECES = 2
"""Pieces of an image that are in work on a CUDA device at one time."""

MADE_AHEAD = Path(os.environ.get("RELIT_KERNELS") or Path(__file__).with_name("cubins"))
"""Folder of the kernels that `relit kernels` compiled ahead, which may come with the package or be shared: it is only read."""

EVERY = "all"
"""Stands for every CUDA device of the machine."""

Given, Made = ParamSpec("Given"), TypeVar("Made")

_build_lock = threading.RLock()
"""Held while a kernel is defined or compiled: Warp's lists of functions and modules are not made for several threads."""


def once(make: Callable[Given, Made]) -> Callable[Given, Made]:
    """Return a function that makes a kernel or a type once for each choice of arguments: `functools.cache` that several threads, each with
    a device of its own, may call for the first time at once."""
    made = cache(make)

    @wraps(make)
    def get(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        with _build_lock:
            return made(*args, **kwargs)

    return get


def resolve(name: str | None = None) -> str:
    """Name the device to use.

    Args:
        name: "cpu", "cuda:0", … or None for the first CUDA device, else the CPU.

    Returns:
        The device's name as Warp spells it.

    Raises:
        DeviceError: the machine has no such device.
    """
    available = names()
    if name is None:
        return next((n for n in available if n.startswith("cuda")), "cpu")
    wanted = "cuda:0" if name == "cuda" else name
    if wanted not in available:
        hint = outdated_driver() if wanted.startswith("cuda") else None
        raise DeviceError(f"device {name} is not on this machine: choose one of {', '.join(available)}{f'; {hint}' if hint else ''}")
    return wanted


def outdated_driver() -> str | None:
    """Return a sentence if the driver of the machine's GPU is too old for Warp, which then finds no GPU, else None."""
    _start()
    driver, toolkit = wp.get_cuda_driver_version(), wp.get_cuda_toolkit_version()
    if driver is None or toolkit is None or driver[0] >= toolkit[0]:
        return None
    return (f"the NVIDIA driver of this machine supports CUDA {driver[0]}.{driver[1]}, and Warp needs CUDA {toolkit[0]}.0 or newer, so "
            "that its GPU cannot be used: install a newer driver")


def batch_bytes(device: str, on_cpu: int) -> int:
    """Return the memory for what a device works on at one time: `on_cpu` bytes on the CPU, 1/16 of the memory of a GPU if that is more.

    On a GPU a batch has to give work to all multiprocessors: 1/16 of an H200 is a million pixels of 96 lights. The whole memory and not
    the free is divided, so that workers that share a solve cut it alike.
    """
    if device == "cpu":
        return on_cpu
    share = 1 << ((wp.get_device(device).total_memory // 16).bit_length() - 1)
    return max(on_cpu, min(share, MOST_BATCH_BYTES))


def free_bytes(device: str) -> int:
    """Return the free memory of a CUDA device."""
    return int(wp.get_device(device).free_memory)


def pieces_at_once(device: str) -> int:
    """Return how many pieces of an image are in work on a device at one time: on CUDA it computes one while the host reads or finishes
    another."""
    return 1 if device == "cpu" else CUDA_PIECES


def resolve_all(name: str | None = None) -> tuple[str, ...]:
    """Name the devices that one work is divided among.

    Args:
        name: a device as `resolve` takes it, several with commas between, or "all" for every CUDA device.

    Returns:
        Their names as Warp spells them, in the given order, each as often as it is given.

    Raises:
        DeviceError: the machine has no such device, or they are of two kinds, whose results differ in the last bits.
    """
    if name == EVERY:
        found = tuple(each for each in names() if each != "cpu")
        if not found:
            raise DeviceError(f"device {EVERY} stands for every CUDA device, and this machine has none: choose cpu")
    else:
        found = (resolve(None),) if name is None else tuple(resolve(part.strip()) for part in name.split(","))
    if len({(each == "cpu", "" if each == "cpu" else wp.get_device(each).name) for each in found}) > 1:
        raise DeviceError(f"devices {name} are of different kinds, which round differently: choose devices of one kind")
    return found


def names() -> list[str]:
    """Return the devices of this machine, the CPU first."""
    _start()
    return ["cpu", *(d.alias for d in wp.get_cuda_devices())]


def describe(device: str) -> str:
    """Return one line that names the device, for reports."""
    return f"cpu, {worker_count()} threads" if device == "cpu" else f"{device}, {wp.get_device(device).name}"


def kind(device: str) -> str:
    """Return what devices have in common that find the same to the last bit: the model, and the count of threads or the compiler."""
    if device == "cpu":
        return f"cpu, {_cpu_model()}, {worker_count()} threads"
    found = wp.get_device(device)
    return f"{found.name}, driver {wp.get_cuda_driver_version()}, {found.get_cuda_output_format()}"


@cache
def _cpu_model() -> str:
    """Return the model of the processor and its instruction sets, for which Warp compiles kernels."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    found = {line.partition(":")[0].strip(): line.partition(":")[2].strip() for line in reversed(lines)}
    return f"{found.get('model name', platform.machine())} {found.get('flags', found.get('Features', ''))}"


def pack_width(device: str) -> int:
    """Return the number of pixels that one thread takes on this device."""
    _start()
    return PACK_CPU if device == "cpu" else PACK_CUDA


def warp_width(device: str) -> int:
    """Return the number of neighbouring threads that run together and can exchange values: 32 on CUDA, else 1."""
    return 32 if wp.get_device(device).is_cuda else 1


def worker_count() -> int:
    """Return the number of CPU threads that a launch is split over: the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def launch(kernel: Any, count: int, inputs: Sequence[Any], outputs: Sequence[Any], *, device: str,
           uneven: bool = False) -> None:
    """Run `count` independent threads of a kernel.

    Args:
        kernel: a Warp kernel whose first argument is `first: int`, the index that its thread 0 stands for, and
            whose threads write to places of their own.
        count: number of threads.
        inputs: the kernel's inputs after `first`.
        outputs: its outputs.
        device: where to run.
        uneven: whether some threads work much longer than others; on the CPU the work is then cut finer.

    Raises:
        ArrayError: more threads than a launch can have.

    Convention:
        On the CPU the call returns when the work is done. On CUDA it returns at once; reading an output waits.
    """
    record(kernel, count, inputs, outputs, device=device, uneven=uneven).run()


class Recorded:
    """A launch with its arguments, to be run any number of times: packing them takes longer than a small launch itself."""

    def __init__(self, commands: list[Any]) -> None:
        self._commands = commands

    def run(self) -> None:
        """Run the threads; returns as `launch` does."""
        if len(self._commands) > 1:
            pool = _pool(worker_count())
            pieces = [pool.submit(command.launch) for command in self._commands]
            try:
                for piece in pieces:
                    piece.result()
            except BaseException:  # of Ctrl-C, too: the arrays that the others write to must not go before them
                for piece in pieces:
                    piece.cancel()
                wait(pieces)
                raise
        elif self._commands:
            self._commands[0].launch()


def record(kernel: Any, count: int, inputs: Sequence[Any], outputs: Sequence[Any], *, device: str, uneven: bool = False,
           brief: int = 0) -> Recorded:
    """Return a launch without running it.

    Args:
        kernel, count, inputs, outputs, device, uneven: as for launch. The arrays must live as long as the record.
        brief: count of threads up to which one core of the CPU has done them before another has been started.

    Raises:
        ArrayError: more threads than a launch can have.
    """
    if count <= 0:
        return Recorded([])
    if count > MAX_THREADS:
        raise ArrayError(f"the work is {count} threads, a launch has at most {MAX_THREADS}: cut it into smaller bands")
    with _build_lock:
        if device == "cpu":
            kernel.module.load(device, block_dim=CPU_BLOCK)
        else:
            load_for_cuda(kernel, device)
    if device != "cpu":
        return Recorded([wp.launch(kernel, dim=count, inputs=[0, *inputs], outputs=list(outputs), device=device, block_dim=CUDA_BLOCK,
                                   record_cmd=True)])
    workers = worker_count()
    blocks = 1 if workers == 1 or count <= brief else min(count, workers * (UNEVEN_BLOCKS if uneven else 1))
    edges = [count * b // blocks for b in range(blocks + 1)]

    # recorded here, so that the pool's threads need the interpreter for a moment only
    return Recorded([wp.launch(kernel, dim=last - first, inputs=[first, *inputs], outputs=list(outputs), device="cpu", record_cmd=True)
                     for first, last in itertools.pairwise(edges)])


def cuda_module(kernel: Any) -> Any:
    """Return the Warp module of a kernel, whose file is from now on named for launches on CUDA."""
    wp.set_module_options({"block_dim": CUDA_BLOCK}, kernel.module)
    return kernel.module


@cache
def load_for_cuda(kernel: Any, device: str) -> None:
    """Load a kernel on a CUDA device from those made ahead or from Warp's cache; where neither has it, compile its package in parallel."""
    for folder in (MADE_AHEAD, None):  # None: the cache
        try:
            return wp.load_aot_module(cuda_module(kernel), device, module_dir=folder, use_ptx=False)
        except FileNotFoundError:
            continue
    from kernels import ahead  # knows all kernels, whose modules know this one

    wp.force_load(device, ahead.package_of(kernel), block_dim=CUDA_BLOCK, max_workers=worker_count())


def to_numpy(array: wp.array) -> np.ndarray:
    """Return an array of any device on the host: a copy, of the CPU's a view; waits for the launches before.

    Warp's own `numpy()` makes the null stream that of the device while it copies, for all threads: two that read at the same time may
    leave it so, and graphs cannot be captured in it. It would also wait for the uploads of other streams.
    """
    return (array if array.device.is_cpu or not array.size else wp.clone(array, device="cpu")).numpy()


@cache
def _start() -> None:
    """Initialise Warp without its line about a missing CUDA driver: a machine without a GPU is an ordinary one here."""
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            said.seek(0)
            for line in said.read().decode(errors="replace").splitlines():
                if "NVIDIA CUDA driver" not in line:
                    print(line, file=sys.stderr)
    for found in wp.get_cuda_devices():
        if found.is_mempool_enabled:
            wp.set_mempool_release_threshold(found, 1.0)  # else every wait for the device gives its memory back


@once
def _pool(workers: int) -> ThreadPoolExecutor:
    """Return a pool of one thread for each core, bound to it where the system allows: two threads on one core would wait for each other."""
    cores = iter(sorted(os.sched_getaffinity(0))) if hasattr(os, "sched_setaffinity") else iter(())

    def settle() -> None:
        core = next(cores, None)
        if core is not None:
            os.sched_setaffinity(0, {core})

    return ThreadPoolExecutor(workers, thread_name_prefix="relit-kernel", initializer=settle)
