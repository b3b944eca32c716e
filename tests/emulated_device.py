"""An emulated `cuda:0`: the CPU under another name, so that the code for CUDA runs on machines without a GPU (`pytest --device-emulated`).

Pack widths, memory layouts and branches are those of CUDA. Its memory is apart from the host's: what is read from it is a copy, what
is passed to a launch must lie in it, and nobody may write past the end of an array. New memory is full of NaN (-1 where counts are meant).
A copy from or to pinned memory waits until something waits for it (emulated_streams.py).
Each launch runs twice, its threads in parts one after another in two orders, and must leave the same bits in all arrays.
What is asked of the device is counted: launches, reads that wait for it, and bytes copied to and from it.

What only hardware shows stays unseen: races within a part, the rounding of its own arithmetic, and errors of its driver.
"""

import atexit
import bisect
import copy
import ctypes
import itertools
import random
from collections import Counter
from collections.abc import Iterator
from threading import RLock, local
from typing import Any

import numpy as np
import warp as wp
from warp._src import context
from warp._src.codegen import StructInstance

from kernels import device as devices
from kernels import graphs
from tests import emulated_streams
from tests.emulated_streams import LAUNCHES, PINNED, Event, Stream

NAME = "cuda:0"
PARTS = 6
"""Parts of a launch that run in two orders."""
TWICE = True
"""Whether a launch runs in two orders, for which the host holds copies of its arrays."""
GUARD = 64
"""Bytes behind each array that nobody may write."""
UNWRITTEN = 0xFF
"""Each byte of new memory: NaN as a float of any size, and -1 as an integer."""
MEMORY = 8 << 30
"""Bytes that the device says it has."""

plain_launch, plain_load, plain_total_memory = context.launch, context.Module.load, context.Device.total_memory
plain_copy, plain_empty, plain_from_data, plain_free_memory = wp.copy, wp.empty, wp.array._init_from_data, context.Device.free_memory
plain_repeated = graphs.Repeated.run
WAITS = "synchronize", "synchronize_device", "synchronize_stream", "synchronize_event"

COUNTED = {"launches": "launches of kernels and of graphs", "graphed": "launches of kernels within graphs",
           "waits": "copies to the host, and calls that do nothing but wait for the device",
           "up": "bytes copied to the device", "down": "bytes copied to the host",
           "touched": "bytes of the arrays that launches were given, each array once a launch"}
counts: Counter[str] = Counter()
"""What all threads have asked of the device so far, by the names of COUNTED."""
counts_lock = RLock()
loaded: set[str] = set()
"""The names of the files of the kernels that were launched."""
graph = local()
"""Has a true `now` in a thread while it does what CUDA does as one graph; the emulated device has no graphs."""


def note(**more: int) -> None:
    with counts_lock:
        counts.update(more)


class Memory:
    """The allocator of the device, which knows what it gave."""

    deallocate_requires_context_guard = False
    memory_kind = context.MemoryKind.HOST

    def __init__(self) -> None:
        self._sizes: dict[int, int] = {}
        self._begins: list[int] = []
        self._lock = RLock()
        self.held = self.peak = 0  # bytes now, and the most since `peak` was set

    def allocate(self, size: int) -> int:
        begin = context.runtime.core.wp_alloc_host(size + GUARD, None)
        ctypes.memset(begin, UNWRITTEN, size + GUARD)
        with self._lock:
            self._sizes[begin] = size
            bisect.insort(self._begins, begin)
            self.held += size
            self.peak = max(self.peak, self.held)
        return begin

    def deallocate(self, begin: int, size: int) -> None:
        for stream in list(Stream.every):
            stream.finish(begin, begin + size)
        with self._lock:
            self._begins.remove(begin)
            given = self._sizes.pop(begin)
            self.held -= given
        sound = (bytes_at(begin + given, GUARD) == UNWRITTEN).all()
        context.runtime.core.wp_free_host(begin)
        if not sound:
            raise AssertionError(f"something was written past the end of an array of {given} bytes")

    @property
    def free(self) -> int:
        return MEMORY - self.held

    def has(self, begin: int, size: int) -> bool:
        with self._lock:
            place = bisect.bisect_right(self._begins, begin) - 1
            return place >= 0 and begin + size <= self._begins[place] + self._sizes[self._begins[place]]


def bytes_at(begin: int, size: int) -> np.ndarray:
    """Return the bytes at an address, as a view."""
    return np.frombuffer((ctypes.c_ubyte * size).from_address(begin), dtype=np.uint8)


def arrays_in(values: Any) -> Iterator[wp.array]:
    """Yield the arrays among the arguments of a launch, those in structs too."""
    for value in values:
        if isinstance(value, wp.array):
            yield value
        elif isinstance(value, StructInstance):
            yield from arrays_in(getattr(value, name) for name in value._cls.vars)


class Launch:
    """A launch on the emulated device, to be run any number of times."""

    def __init__(self, kernel: Any, dim: Any, inputs: Any, outputs: Any, options: dict[str, Any]) -> None:
        first, *_ = kernel.adj.args
        edges = [0, dim]
        self._name = kernel.key
        self._arrays = list(arrays_in([*inputs, *outputs]))
        places = {}
        for array in self._arrays:
            if array.size:
                size = sum((n - 1) * stride for n, stride in zip(array.shape, array.strides, strict=True))
                places[array.ptr] = max(places.get(array.ptr, 0), size + wp.types.type_size_in_bytes(array.dtype))
        for begin, size in places.items():
            if not memory.has(begin, size):
                raise AssertionError(f"{self._name} is given {size} bytes that are not in the memory of {NAME}")
        self._memory = [bytes_at(begin, size) for begin, size in places.items()]
        self._touched = sum(places.values())
        if first.label == "first" and isinstance(dim, int):
            edges[1:1] = sorted(random.Random(dim).sample(range(1, dim), min(dim - 1, PARTS - 1)))
            starts = [[inputs[0] + start, *inputs[1:]] for start in edges[:-1]]
        else:
            starts = [inputs]
        sizes = [last - start for start, last in itertools.pairwise(edges)] if len(starts) > 1 else [dim]
        self._parts = [plain_launch(kernel, dim=size, inputs=given, outputs=outputs, record_cmd=True, **options)
                       for size, given in zip(sizes, starts, strict=True)]

    def launch(self) -> None:
        LAUNCHES.go_on()
        note(**{"graphed" if getattr(graph, "now", False) else "launches": 1}, touched=self._touched)
        before = [place.copy() for place in self._memory] if TWICE else []
        for part in reversed(self._parts):
            part.launch()
        if len(self._parts) == 1 or not TWICE:
            return
        after = [place.copy() for place in self._memory]
        for place, held in zip(self._memory, before, strict=True):
            place[:] = held
        for part in random.Random(len(before)).sample(self._parts, len(self._parts)):
            part.launch()
        if any((place != held).any() for place, held in zip(self._memory, after, strict=True)):
            raise AssertionError(f"what {self._name} leaves depends on the order of its threads")


def launch(kernel: Any, dim: Any, inputs: Any = (), outputs: Any = (), device: Any = None, record_cmd: bool = False, **options: Any) -> Any:
    if context.runtime.get_device(device) is not emulated:
        return plain_launch(kernel, dim, inputs, outputs, device=device, record_cmd=record_cmd, **options)
    options.pop("block_dim", None)
    if np.prod(dim) == 0 or getattr(kernel, "is_generic", False):
        return plain_launch(kernel, dim, inputs, outputs, device=device, record_cmd=record_cmd, **options)
    made = Launch(kernel, dim, list(inputs), list(outputs), {"device": device, **options})
    return made if record_cmd else made.launch()


def load(module: Any, device: Any, block_dim: int | None = None, *args: Any, **options: Any) -> Any:
    """Compile for the emulated device as for the CPU."""
    is_emulated = context.runtime.get_device(device) is emulated
    return plain_load(module, context.runtime.cpu_device if is_emulated else device, 1 if is_emulated else block_dim, *args, **options)


def load_kernel(kernel: Any, device: str) -> None:
    loaded.add(kernel.module.get_module_identifier(devices.CUDA_BLOCK))
    load(kernel.module, device)


def copy_array(dest: Any, src: Any, dest_offset: int = 0, src_offset: int = 0, count: int = 0, stream: Stream | None = None) -> None:
    if emulated not in (dest.device, src.device):
        plain_copy(dest, src, dest_offset, src_offset, count, stream)
        return
    size = (count or src.size) * wp.types.type_size_in_bytes(src.dtype)
    if src.device is not emulated:
        note(up=size)
    elif dest.device is not emulated:
        note(down=size, waits=not PINNED.has(dest))
    emulated_streams.copy(plain_copy, UNWRITTEN, dest, src, dest_offset, src_offset, count, stream)


def empty(shape: Any = None, *args: Any, pinned: bool = False, **options: Any) -> Any:
    return PINNED.empty(plain_empty, UNWRITTEN, shape, options) if pinned else plain_empty(shape, *args, **options)


def from_data(array: Any, data: Any, dtype: Any, shape: Any, device: Any, copied: bool, pinned: bool) -> None:
    """Copy host data to the emulated device, whether the caller asks for it or not."""
    is_emulated = context.runtime.get_device(device) is emulated
    plain_from_data(array, data, dtype, shape, device, copied or is_emulated, pinned)


def counting_waits(synchronise: Any) -> Any:
    """Return a call of Warp's that waits for the device, counted."""
    def wait(*given: Any) -> None:
        note(waits=1)
        synchronise(*given)

    return wait


def counting_graphs(repeated: graphs.Repeated) -> None:
    """Do the launches of a graph, which are one."""
    if repeated.device == NAME:
        note(launches=1)
        graph.now = True
    try:
        plain_repeated(repeated)
    finally:
        graph.now = False


def is_same(device: Any, other: Any) -> bool:
    """Compare devices; Warp compares their contexts, of which neither the CPU nor the emulated device has one."""
    return device.alias == str(other)


def installed() -> bool:
    """Return whether `cuda:0` is emulated: a GPU has the same name."""
    return wp.launch is launch


def install() -> None:
    """Add the device to those of Warp, for the rest of the process."""
    global emulated, memory
    runtime = context.runtime
    emulated, memory = copy.copy(runtime.cpu_device), Memory()
    emulated.alias, emulated.name, emulated.default_allocator = NAME, "emulated", memory
    runtime.device_map[NAME] = emulated
    runtime.cuda_devices.append(emulated)
    context.Device.__eq__ = is_same
    context.Device.total_memory = property(lambda device: MEMORY if device is emulated else plain_total_memory.fget(device))
    context.Device.free_memory = property(lambda device: memory.free if device is emulated else plain_free_memory.fget(device))
    context.Module.load = load
    devices.load_for_cuda = load_kernel
    wp.array._init_from_data = from_data
    wp.launch = context.launch = launch
    wp.copy = context.copy = copy_array
    wp.empty = context.empty = empty
    graphs.Repeated.run = counting_graphs
    atexit.register(Stream.forget)
    wp.Stream, wp.Event, wp.get_stream, wp.synchronize_event = Stream, Event, lambda device=None: LAUNCHES, Event.synchronize
    for name in WAITS:
        setattr(wp, name, counting_waits(getattr(wp, name)))
