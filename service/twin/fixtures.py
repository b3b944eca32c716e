"""What the fixtures of a rig show when packets arrive, by the rules of E1.31 and Art-Net."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from service.twin.packets import DataPacket, SyncPacket
from stage.rig.rig import CHANNELS

LOSS_S = 2.5
"""A source that has sent nothing for so long is gone (E1.31-2018, network data loss timeout)."""
ARTSYNC_S = 4.0
"""Values of Art-Net wait for an ArtSync if the last one is not older (Art-Net 4, ArtSync)."""
OUT_OF_ORDER = 20
"""A packet is left out if its number is that of the last one, or fewer than so many before it (E1.31-2018, section 6.7.2)."""

UniverseId = tuple[str, int]
"""Protocol and number of a universe."""


@dataclass
class _Source:
    """A source as a universe knows it."""

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

        Args:
            now: the time, s, of any clock.
        """
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
