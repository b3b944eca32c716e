"""Uploads that go on while the device computes: host rows through pinned memory, in a stream of their own.

A copy from ordinary memory is made by the driver in small pieces while the caller waits; one from pinned memory goes on beside it. Two
pinned buffers take turns: one is filled, from a mapped file for example, while the other is copied.

Warp frees memory in the device's null stream, which waits for all streams, so that a kernel after it waits for an upload that is under
way; what the host does for the upload always overlaps.
"""

from threading import Lock

import numpy as np
import warp as wp

from kernels.device import once

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
