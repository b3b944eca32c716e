"""Receive packets on the ports of sACN and Art-Net, on a thread, and keep the frames that fixtures show."""

import selectors
import socket
import threading
import time
from collections.abc import Collection
from typing import NamedTuple, Self

import numpy as np

from service.errors import RequestError
from service.twin.fixtures import ARTNET_PORT, SACN_PORT, Fixtures, UniverseId, read_artnet, read_sacn

ANY = "0.0.0.0"
RECEIVE_BYTES = 4 << 20
"""The buffer of packets that have arrived: those of several frames of many universes."""
LARGEST_PACKET = 2048
SYNC_UNIVERSE = 63999
"""The universe of synchronisation packets that relit play and the package sacn send."""


class ReceivedFrame(NamedTuple):
    """A whole frame."""

    number: int
    """From 1; 0 before the first."""
    time_s: float
    """Seconds since the twin began to listen."""
    values: dict[UniverseId, np.ndarray]
    """[512] uint8 by universe."""


class Listener:
    """Listens as long as it is open."""

    def __init__(self, universes: Collection[UniverseId], interface: str, *, keep: bool, most: int | None = None) -> None:
        """Bind the ports.
        `keep`: whether all frames are kept, and not the last one alone. `most`: the number of frames after which nothing is received any
        more; None: there is no end. Raises RequestError if a port is in use, the address is not one of this machine, or the network refuses
        multicast."""
        self.fixtures = Fixtures(universes)
        self.kept: list[ReceivedFrame] = []
        self.last = ReceivedFrame(0, 0.0, dict(self.fixtures.shown))
        self._keep, self._most, self._changed, self._closing = keep, most, threading.Condition(), False
        self._sacn = _bound(interface, SACN_PORT, "sACN")
        try:
            self._artnet = _bound(interface, ARTNET_PORT, "Art-Net")
            if interface == ANY:
                _join(self._sacn, [number for protocol, number in universes if protocol == "sacn"])
        except RequestError:
            self.close()
            raise
        self._began = time.monotonic()
        self._thread = threading.Thread(target=self._listen, name="relit-twin", daemon=True)

    def __enter__(self) -> Self:
        """Begin to listen."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread, and free the ports."""
        self._closing = True
        self._thread.join()
        self.close()

    def close(self) -> None:
        """Free the ports."""
        self._sacn.close()
        if hasattr(self, "_artnet"):
            self._artnet.close()

    def wait(self, frames: int | None, until: float | None) -> None:
        """Wait until so many frames have been received, or for a moment of the monotonic clock, whichever comes first."""
        with self._changed:
            self._changed.wait_for(lambda: frames is not None and self.last.number >= frames,
                                   None if until is None else max(0.0, until - time.monotonic()))

    def _listen(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._sacn, selectors.EVENT_READ)
            selector.register(self._artnet, selectors.EVENT_READ)
            while not self._closing:
                for key, _ in selector.select(timeout=0.1):
                    self._receive(key.fileobj)  # type: ignore[arg-type]

    def _receive(self, ready: socket.socket) -> None:
        data, sender = ready.recvfrom(LARGEST_PACKET)
        packet = read_sacn(data) if ready is self._sacn else read_artnet(data, sender[0])
        now = time.monotonic()
        if packet is None or self.last.number == self._most or not self.fixtures.take(packet, now):
            return
        with self._changed:
            self.last = ReceivedFrame(self.last.number + 1, now - self._began, dict(self.fixtures.shown))
            if self._keep:
                self.kept.append(self.last)
            self._changed.notify_all()


def _bound(interface: str, port: int, protocol: str) -> socket.socket:
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
        listening.bind((interface, port))
    except OSError as error:
        listening.close()
        raise RequestError(f"--interface {interface}: cannot listen on port {port} ({protocol}): {(error.strerror or str(error)).lower()}"
                           ) from error
    return listening


def _join(listening: socket.socket, universes: Collection[int]) -> None:
    """Join the multicast groups of universes, and of the synchronisation."""
    for universe in (*universes, SYNC_UNIVERSE):
        group = f"239.255.{universe >> 8}.{universe & 255}"
        try:
            listening.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + socket.inet_aton(ANY))
        except OSError as error:
            raise RequestError(f"--interface {ANY}: the network refuses multicast of universe {universe}: "
                               f"{(error.strerror or str(error)).lower()}") from error
