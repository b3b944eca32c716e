"""Fixtures of a rig, which take packets of sACN and Art-Net and show their levels.

Source: ANSI E1.31-2018, sections 4 to 7; Art-Net 4 protocol specification, ArtDmx and ArtSync.
"""

import struct
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stage.rig.rig import CHANNELS

SACN_PORT, ARTNET_PORT = 5568, 6454
DEFAULT_PRIORITY = 100
"""The priority of sources that have none, as in Art-Net."""
_SACN_ID, _ARTNET_ID = b"ASC-E1.17\0\0\0", b"Art-Net\0"
_ROOT_DATA, _ROOT_EXTENDED, _FRAME_DATA, _FRAME_SYNC = 4, 8, 2, 1
_PREVIEW, _TERMINATED = 0x80, 0x40
_ARTDMX, _ARTSYNC = 0x5000, 0x5200
LOSS_S = 2.5
"""A source that has sent nothing for so long is gone (E1.31-2018, network data loss timeout)."""
ARTSYNC_S = 4.0
"""Values of Art-Net wait for an ArtSync if the last one is not older (Art-Net 4, ArtSync)."""
OUT_OF_ORDER = 20
"""A packet is left out if its number is that of the last one, or fewer than so many before it (E1.31-2018, section 6.7.2)."""

UniverseId = tuple[str, int]
"""Protocol and number of a universe."""


class DataPacket(NamedTuple):
    """The values of a universe."""

    protocol: str
    universe: int
    source: bytes
    """What tells sources apart: the CID in sACN, the address in Art-Net."""
    priority: int
    sequence: int | None
    """The number of the packet, modulo 256; None: the source does not count."""
    sync: int
    """The universe of the synchronisation packet at which the values are shown; 0: at once."""
    terminated: bool
    """Whether the source says that this is the end of its stream."""
    values: bytes


class SyncPacket(NamedTuple):
    """The moment at which values that wait are shown."""

    protocol: str
    sync: int
    """The universe that packets of values name; 0 in Art-Net."""


def read_sacn(data: bytes) -> DataPacket | SyncPacket | None:
    """Return what a datagram says to fixtures; None for anything else, such as previews and values of other start codes."""
    if len(data) < 49 or data[4:16] != _SACN_ID:
        return None
    root, frame = struct.unpack_from(">I", data, 18)[0], struct.unpack_from(">I", data, 40)[0]
    if (root, frame) == (_ROOT_EXTENDED, _FRAME_SYNC):
        return SyncPacket("sacn", struct.unpack_from(">H", data, 45)[0])
    if (root, frame) != (_ROOT_DATA, _FRAME_DATA) or len(data) < 126:
        return None
    priority, sync, sequence, options, universe = struct.unpack_from(">BHBBH", data, 108)
    count, start_code = struct.unpack_from(">HB", data, 123)
    if options & _PREVIEW or start_code != 0:
        return None
    return DataPacket("sacn", universe, data[22:38], priority, sequence, sync, bool(options & _TERMINATED), data[126:125 + count])


def read_artnet(data: bytes, address: str) -> DataPacket | SyncPacket | None:
    """Return what a datagram from an address says to fixtures; None for anything else."""
    if len(data) < 14 or data[:8] != _ARTNET_ID:
        return None
    operation = struct.unpack_from("<H", data, 8)[0]
    if operation == _ARTSYNC:
        return SyncPacket("artnet", 0)
    if operation != _ARTDMX or len(data) < 18:
        return None
    sequence, universe, count = data[12], struct.unpack_from("<H", data, 14)[0], struct.unpack_from(">H", data, 16)[0]
    return DataPacket("artnet", universe, address.encode(), DEFAULT_PRIORITY, sequence or None, 0, False, data[18:18 + count])


@dataclass
class _Source:
    priority: int
    sequence: int | None
    seen: float
    values: np.ndarray  # [512] uint8


class Fixtures:
    """The universes of a rig. When no source is left, they keep what they showed last, as most fixtures do."""

    def __init__(self, universes: Collection[UniverseId]) -> None:
        """Begin dark."""
        self.shown: dict[UniverseId, np.ndarray] = {universe: np.zeros(CHANNELS, dtype=np.uint8) for universe in universes}
        self.out_of_order = 0
        """Number of packets that were left out because a later one had arrived."""
        self._sources: dict[UniverseId, dict[bytes, _Source]] = {universe: {} for universe in universes}
        self._waiting: dict[UniverseId, tuple[int, np.ndarray]] = {}
        self._fresh: set[UniverseId] = set()
        self._artsync: float | None = None

    @property
    def sources(self) -> int:
        """The number of sources that have a stream."""
        return len({source for sources in self._sources.values() for source in sources})

    def take(self, packet: DataPacket | SyncPacket, now: float) -> bool:
        """Take a packet; return True if a whole frame is shown by it.

        A frame is whole at a synchronisation, or, of universes that are not synchronised, when each has got new values.
        `now`: the time, s, of any clock."""
        if isinstance(packet, SyncPacket):
            return self._synchronise(packet, now)
        universe = packet.protocol, packet.universe
        if universe not in self.shown:
            return False
        sources = self._sources[universe]
        for lost in [name for name, source in sources.items() if now - source.seen > LOSS_S]:
            del sources[lost]
        if packet.source in sources and not _follows(packet.sequence, sources[packet.source].sequence):
            self.out_of_order += 1
            return False
        if packet.terminated:
            sources.pop(packet.source, None)
            self._waiting.pop(universe, None)
            if sources:
                self._show(universe, _merged(sources))
            return False
        values = np.zeros(CHANNELS, dtype=np.uint8)
        received = np.frombuffer(packet.values[:CHANNELS], dtype=np.uint8)
        values[:len(received)] = received
        sources[packet.source] = _Source(packet.priority, packet.sequence, now, values)
        if packet.priority < max(source.priority for source in sources.values()):
            return False
        if packet.sync or (packet.protocol == "artnet" and self._artsync is not None and now - self._artsync < ARTSYNC_S):
            self._waiting[universe] = packet.sync, _merged(sources)
            return False
        self._waiting.pop(universe, None)
        return self._show(universe, _merged(sources))

    def _synchronise(self, packet: SyncPacket, now: float) -> bool:
        if packet.protocol == "artnet":
            self._artsync = now
        due = [universe for universe, (sync, _) in self._waiting.items() if (universe[0], sync) == packet]
        for universe in due:
            self.shown[universe] = self._waiting.pop(universe)[1]
        self._fresh.clear()
        return bool(due)

    def _show(self, universe: UniverseId, values: np.ndarray) -> bool:
        self.shown[universe] = values
        self._fresh.add(universe)
        if len(self._fresh) < len(self.shown):
            return False
        self._fresh.clear()
        return True


def _follows(sequence: int | None, last: int | None) -> bool:
    """Return whether a packet comes after the last one by its number."""
    if sequence is None or last is None:
        return True
    ahead = (sequence - last + 128) % 256 - 128
    return not -OUT_OF_ORDER < ahead <= 0


def _merged(sources: dict[bytes, _Source]) -> np.ndarray:
    """Return the values of the sources of highest priority, of several the highest in each channel."""
    highest = max(source.priority for source in sources.values())
    return np.maximum.reduce([source.values for source in sources.values() if source.priority == highest])
