"""Streams, events and pinned memory of the emulated device: a copy is made as late as the device may make it.

A copy from or to pinned memory, or in another stream than that of the launches, is made when its stream is waited for: when an event
behind it is synchronised, when a stream that waits for such an event goes on, or at the next launch in its own stream. Until then its
target is full of NaN, and whoever writes to its source changes what it copies: a wait that is missing shows as wrong values.
"""

import ctypes
from collections import deque
from collections.abc import Callable
from threading import RLock
from typing import Any, ClassVar
from weakref import WeakSet

_lock = RLock()
"""Held while work of streams is done: a stream may do that of another."""


class Event:
    """A point in the work of a stream."""

    def __init__(self, device: Any = None) -> None:
        self.device, self.stream, self.place = device, LAUNCHES, 0

    def synchronize(self) -> None:
        self.stream.go_on(self.place)


class Stream:
    """Work that is done in its order, as late as possible."""

    is_capturing = False
    every: ClassVar["WeakSet[Stream]"] = WeakSet()

    def __init__(self, device: Any = None) -> None:
        self.device = device
        self._work: deque[tuple[Callable[[], None], int, int]] = deque()
        self._done = 0
        self.every.add(self)

    def add(self, work: Callable[[], None], begin: int = 0, end: int = 0) -> None:
        """Put work behind the other; `begin` and `end` are the addresses of the memory on the device that it uses."""
        with _lock:
            self._work.append((work, begin, end))

    def go_on(self, until: int | None = None) -> None:
        """Do the work up to a place, or all of it."""
        with _lock:
            while self._work and (until is None or self._done < until):
                self._done += 1
                self._work.popleft()[0]()

    @classmethod
    def forget(cls) -> None:
        """Leave undone what nothing waits for any more."""
        for stream in cls.every:
            stream._work.clear()

    def finish(self, begin: int, end: int) -> None:
        """Do the work that uses memory between these addresses, and what comes before it."""
        with _lock:
            using = [n for n, (_, first, last) in enumerate(self._work, start=1) if first < end and begin < last]
            if using:
                self.go_on(self._done + using[-1])

    def record_event(self, event: Event | None = None) -> Event:
        event = event or Event(self.device)
        with _lock:
            event.stream, event.place = self, self._done + len(self._work)
        return event

    def wait_event(self, event: Event) -> None:
        stream, place = event.stream, event.place  # the event may be recorded again
        self.add(lambda: stream.go_on(place))


LAUNCHES = Stream()
"""The stream of launches, and of copies for which no other is named."""


class PinnedMemory:
    """Which host memory is pinned; it lives as long as the process."""

    def __init__(self) -> None:
        self._arrays: list[Any] = []

    def empty(self, plain_empty: Callable[..., Any], unwritten: int, shape: Any, options: dict[str, Any]) -> Any:
        array = plain_empty(shape, **options)
        ctypes.memset(array.ptr, unwritten, array.capacity)
        self._arrays.append(array)
        return array

    def has(self, array: Any) -> bool:
        return any(pinned.ptr <= array.ptr < pinned.ptr + pinned.capacity for pinned in self._arrays)


PINNED = PinnedMemory()


def copy(plain_copy: Callable[..., None], unwritten: int, dest: Any, src: Any, dest_offset: int, src_offset: int, count: int,
         stream: Stream | None) -> None:
    """Copy from, to or on the emulated device."""
    stream = stream or LAUNCHES

    def work() -> None:
        plain_copy(dest, src, dest_offset, src_offset, count, stream)

    if not (dest.is_contiguous and src.is_contiguous) or (stream is LAUNCHES and not PINNED.has(dest) and not PINNED.has(src)):
        stream.go_on()
        work()
        return
    item = dest.strides[-1]
    size = (count or src.size) * item
    ctypes.memset(dest.ptr + dest_offset * item, unwritten, size)
    on_device, offset = (src, src_offset) if PINNED.has(dest) else (dest, dest_offset)
    stream.add(work, on_device.ptr + offset * item, on_device.ptr + offset * item + size)
