"""The captured images on a device, read as often as a solve or the frames of a range need them.

On the CPU a band is a view of the stack's file. On CUDA the stack is cut into blocks, which are uploaded once and stay where half of the
free memory holds them all, so that every further pass reads device memory. Where it does not, the blocks that were used last stay. While
the device works on one block, a thread uploads the next: the file's pages are read straight into pinned memory.

A copy from ordinary memory is made by the driver in small pieces while the caller waits; one from pinned memory goes on beside it. Two
pinned buffers take turns: one is filled, from a mapped file for example, while the other is copied. Warp frees memory in the device's null
stream, which waits for all streams, so that a kernel after it waits for an upload that is under way; what the host does for the upload
always overlaps.
"""

from collections import OrderedDict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import warp as wp

from kernels import device as devices
from kernels import packs
from kernels.device import once
from kernels.packs import Band, as_packs, as_pixels, pack_type

STAGED_BYTES = 64 << 20
"""Bytes of each of the two pinned buffers of a device."""


class Staging:
    """The pinned buffers of a device and the stream of their copies."""

    def __init__(self, device: str) -> None:
        self._device, self._lock, self._turn = device, Lock(), 0
        self._stream = wp.Stream(device)
        self._buffers = [wp.empty(STAGED_BYTES, dtype=wp.uint8, device="cpu", pinned=True) for _ in range(2)]
        self._copied = [self._stream.record_event() for _ in range(2)]

    def upload(self, rows: np.ndarray, target: wp.array, after: wp.Event) -> wp.Event:
        """Begin to copy rows to the device; returns when the host has read them.

        Args:
            rows: [row, pixel] of any strides; one row fits into a buffer.
            target: contiguous memory on the device, of as many bytes.
            after: the copy begins when this event has happened.

        Returns:
            The event after the copy, which a stream waits for before it reads the target.
        """
        row_bytes = rows.shape[1] * rows.itemsize
        step = STAGED_BYTES // row_bytes
        whole = wp.array(ptr=target.ptr, shape=(len(rows) * row_bytes,), dtype=wp.uint8, device=self._device, copy=False)
        with self._lock:
            self._stream.wait_event(after)
            for first in range(0, len(rows), step):
                part = rows[first : first + step]
                self._turn = 1 - self._turn
                buffer, copied = self._buffers[self._turn], self._copied[self._turn]
                wp.synchronize_event(copied)
                size = len(part) * row_bytes
                np.copyto(buffer.numpy()[:size].view(part.dtype).reshape(part.shape), part)
                wp.copy(whole, buffer, dest_offset=first * row_bytes, count=size, stream=self._stream)
                self._copied[self._turn] = self._stream.record_event()
            return self._stream.record_event()


@once
def staging(device: str) -> Staging:
    """Return the staging of a CUDA device, which all its uploads share: the driver takes milliseconds to pin memory."""
    return Staging(device)


LEAST_BLOCKS = 4
"""Blocks that a device holds at least: two pieces of the image that are worked on side by side touch two each."""


class Images(Protocol):
    """A stack of images as stage.stack has it, whose methods say more."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, padded count of lights, padded count of pixels."""

    def bands(self, bytes_per_pixel: int = 0) -> Iterable[tuple[int, int]]:
        """Pixel ranges that cover the image."""

    def band(self, start: int, stop: int) -> np.ndarray:
        """[channel, light, pixel] float16 of a range."""

    def saturated(self, start: int, stop: int) -> np.ndarray:
        """[light / 8, pixel] uint8 bits of a range."""

    def pick(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both of single pixels."""


Stack = TypeVar("Stack", bound=Images)


class _Room(NamedTuple):
    """Memory of a block on the device."""

    values: wp.array  # [channel · light, pack] half packs
    bits: wp.array  # [light / 8, pack] uint8 packs
    owner: tuple[wp.array, wp.array]
    free: wp.Event
    """Nothing that was begun before this event reads or writes the memory after it."""


class ImagesOnDevice(Generic[Stack]):
    """The bands of a stack on a device; several threads may ask for them."""

    def __init__(self, stack: Stack, device: str) -> None:
        """Take memory for the blocks; the images are read when they are first asked for."""
        self.stack, self.device = stack, device
        self._blocks: list[tuple[int, int]] = []
        if device == "cpu":
            return
        channels, lights, _ = stack.shape
        self._blocks = list(stack.bands())
        widest = self._blocks[0][1] - self._blocks[0][0]
        block_bytes = (2 * channels * lights + lights // 8) * widest
        most = max(LEAST_BLOCKS, devices.free_bytes(device) // 2 // block_bytes)
        owners = [(wp.empty((channels * lights, widest), dtype=wp.float16, device=device),
                   wp.empty((lights // 8, widest), dtype=wp.uint8, device=device)) for _ in range(min(most, len(self._blocks)))]
        made = wp.get_stream(device).record_event()
        self._free = [_Room(as_packs(values, device), as_packs(bits, device), (values, bits), made) for values, bits in owners]
        self._room_count = len(owners)
        self._held: OrderedDict[int, tuple[_Room, wp.Event]] = OrderedDict()
        self._lock = Lock()
        self._ahead = ThreadPoolExecutor(1, thread_name_prefix="relit-read-ahead")

    def spans(self, bytes_per_pixel: int) -> list[tuple[int, int]]:
        """Return pixel ranges that cover the image, for work that needs as many bytes of host memory for each pixel beside the images."""
        return self._blocks or list(self.stack.bands(bytes_per_pixel))

    def band(self, start: int, stop: int, *, saturated: bool = True) -> Band:
        """Return the images of a pixel range.

        Args:
            start, stop: multiples of 64.
            saturated: whether the saturation bits are wanted; without them they may be 0.
        """
        if self.device == "cpu":
            return packs.upload(self.stack.band(start, stop), self.stack.saturated(start, stop) if saturated else None, device="cpu")
        if self._room_count == len(self._blocks) and (start, stop) in self._blocks:
            with self._lock:
                return self._bring(self._blocks.index((start, stop)))
        return self.pick(np.arange(start, stop))

    def around(self, pixels: np.ndarray) -> tuple[Band, np.ndarray]:
        """Return a band with pixels [n], ascending and near each other, and their positions in it."""
        if self.device != "cpu":
            return self.pick(pixels), np.arange(len(pixels))
        pack = devices.PACK_CPU
        start = int(pixels[0]) // pack * pack
        return self.band(start, (int(pixels[-1]) // pack + 1) * pack), pixels - start

    def pick(self, pixels: np.ndarray) -> Band:
        """Return the images of single pixels, [n] positions in any order."""
        touched = () if self.device == "cpu" else np.unique(np.searchsorted([stop for _, stop in self._blocks], pixels, side="right"))
        if self.device == "cpu" or len(touched) > self._room_count:
            return packs.upload(*self.stack.pick(pixels), device=self.device)
        channels, lights, _ = self.stack.shape
        rows, count = (channels * lights, lights // 8), len(pixels)
        found = [packs.zeros(count, kind, self.device, rows=each) for kind, each in zip((wp.float16, wp.uint8), rows, strict=True)]
        where = wp.array(pixels, dtype=wp.int32, device=self.device)
        for number in touched:
            with self._lock:  # until the launches are in the stream, no other thread gives the block's memory away
                block = self._bring(int(number))
                for source, target in zip((block.values, block.saturated), found, strict=True):
                    packs.take_columns(as_pixels(source), where, self._blocks[number][0], target)
        values, bits = (as_packs(each, self.device) for each in found)
        return Band(values, bits, count, lights, self.device, tuple(found))

    def finish(self) -> None:
        """Wait until nothing is being read ahead: a CUDA graph that is captured must not meet another thread's events."""
        if self.device != "cpu":
            self._ahead.submit(int).result()

    def _bring(self, number: int) -> Band:
        """Return a block, which the stream of launches waits for, and begin to upload the next; the lock is held."""
        room, there = self._upload(number)
        wp.get_stream(self.device).wait_event(there)
        if number + 1 < len(self._blocks) and number + 1 not in self._held:
            self._ahead.submit(self._upload_ahead, number + 1)
        start, stop = self._blocks[number]
        return Band(room.values, room.bits, stop - start, self.stack.shape[1], self.device, (self, room.owner))

    def _upload_ahead(self, number: int) -> None:
        with self._lock:
            self._upload(number)

    def _upload(self, number: int) -> tuple[_Room, wp.Event]:
        """Return the memory of a block, and the event from which on the images are in it; the lock is held."""
        if number not in self._held:
            channels, lights, _ = self.stack.shape
            start, stop = self._blocks[number]
            values, bits = self.stack.band(start, stop).reshape(channels * lights, stop - start), self.stack.saturated(start, stop)
            room = self._free.pop() if self._free else self._given_back()
            pack = devices.pack_width(self.device)
            room = room._replace(values=_first(room.owner[0], stop - start, pack), bits=_first(room.owner[1], stop - start, pack))
            staging(self.device).upload(values, room.values, room.free)
            self._held[number] = room, staging(self.device).upload(bits, room.bits, room.free)
        self._held.move_to_end(number)
        return self._held[number]

    def _given_back(self) -> _Room:
        """Return the memory of the block that was used longest ago."""
        _, (room, _) = self._held.popitem(last=False)
        return room._replace(free=wp.get_stream(self.device).record_event())


def _first(owner: wp.array, pixels: int, pack: int) -> wp.array:
    """Return the beginning of [rows, widest] memory as contiguous [rows, pixels / pack] packs."""
    return wp.array(ptr=owner.ptr, shape=(owner.shape[0], pixels // pack), dtype=pack_type(pack, owner.dtype), device=owner.device,
                    copy=False)
