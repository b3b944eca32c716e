"""Packets of sACN and Art-Net, as a fixture reads them.

Source: ANSI E1.31-2018, sections 4 to 7; Art-Net 4 protocol specification, ArtDmx and ArtSync.
"""

import struct
from typing import NamedTuple

SACN_PORT, ARTNET_PORT = 5568, 6454
DEFAULT_PRIORITY = 100
"""The priority of sources that have none, as in Art-Net."""
_SACN_ID, _ARTNET_ID = b"ASC-E1.17\0\0\0", b"Art-Net\0"
_ROOT_DATA, _ROOT_EXTENDED, _FRAME_DATA, _FRAME_SYNC = 4, 8, 2, 1
_PREVIEW, _TERMINATED = 0x80, 0x40
_ARTDMX, _ARTSYNC = 0x5000, 0x5200


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
