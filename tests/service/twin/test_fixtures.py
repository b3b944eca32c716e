"""Fixtures follow E1.31 and Art-Net: sequence, priority, synchronisation, termination and loss of sources."""

import numpy as np

from service.twin.fixtures import ARTSYNC_S, LOSS_S, DataPacket, Fixtures, SyncPacket, read_artnet, read_sacn

ONE, TWO = ("sacn", 1), ("sacn", 2)


def data(universe: int = 1, level: int = 0, *, source: bytes = b"a", priority: int = 100, sequence: int | None = 0, sync: int = 0,
         terminated: bool = False, protocol: str = "sacn") -> DataPacket:
    return DataPacket(protocol, universe, source, priority, sequence, sync, terminated, bytes([level] * 512))


def shown(fixtures: Fixtures, universe=ONE) -> int:
    assert len(set(fixtures.shown[universe].tolist())) == 1
    return int(fixtures.shown[universe][0])


def test_a_packet_that_is_overtaken_is_left_out():
    fixtures = Fixtures([ONE])
    assert fixtures.take(data(level=1, sequence=254), 0)
    assert fixtures.take(data(level=2, sequence=1), 0)  # over the end of a byte
    for sequence in (1, 0, 255, 254, 238):
        assert not fixtures.take(data(level=9, sequence=sequence), 0)
    assert (shown(fixtures), fixtures.out_of_order) == (2, 5)
    assert fixtures.take(data(level=3, sequence=237), 0) and shown(fixtures) == 3  # twenty behind: a source that began again


def test_the_highest_priority_wins_and_equal_ones_merge():
    fixtures = Fixtures([ONE])
    fixtures.take(data(level=10), 0)
    assert fixtures.take(data(level=5, source=b"b", priority=120), 0) and shown(fixtures) == 5
    assert not fixtures.take(data(level=200, sequence=1), 0.1) and shown(fixtures) == 5
    fixtures.take(data(level=7, source=b"c", priority=120), 0.2)
    assert shown(fixtures) == 7 and fixtures.sources == 3
    assert not fixtures.take(data(source=b"c", sequence=1, priority=120, terminated=True), 0.3) and shown(fixtures) == 5
    fixtures.take(data(source=b"b", sequence=1, priority=120, terminated=True), 0.3)
    assert shown(fixtures) == 200


def test_a_source_that_is_silent_is_lost_and_the_last_look_stays():
    fixtures = Fixtures([ONE])
    fixtures.take(data(level=90, source=b"b", priority=200), 0)
    assert not fixtures.take(data(level=1), LOSS_S - 0.1)
    assert fixtures.take(data(level=2, sequence=1), LOSS_S + 0.1) and shown(fixtures) == 2
    fixtures.take(data(sequence=2, terminated=True), LOSS_S + 0.2)
    assert shown(fixtures) == 2 and fixtures.sources == 0


def test_synchronised_universes_change_together():
    fixtures = Fixtures([ONE, TWO])
    for frame in range(3):
        assert not fixtures.take(data(1, 10 + frame, sequence=frame, sync=7), frame)
        assert not fixtures.take(data(2, 10 + frame, sequence=frame, sync=7), frame)
        assert not fixtures.take(SyncPacket("sacn", 8), frame)  # another source's
        assert shown(fixtures) == (9 + frame if frame else 0)
        assert fixtures.take(SyncPacket("sacn", 7), frame)
        assert (shown(fixtures), shown(fixtures, TWO)) == (10 + frame, 10 + frame)
    assert not fixtures.take(SyncPacket("sacn", 7), 3)  # nothing waits


def test_artsync_binds_while_it_comes():
    fixtures = Fixtures([("artnet", 0), ("artnet", 1)])
    assert not fixtures.take(data(0, 1, protocol="artnet", sequence=None), 0)
    assert fixtures.take(data(1, 1, protocol="artnet", sequence=None), 0)  # both: a frame
    fixtures.take(SyncPacket("artnet", 0), 1)
    assert not fixtures.take(data(0, 2, protocol="artnet", sequence=None), 1) and shown(fixtures, ("artnet", 0)) == 1
    assert fixtures.take(SyncPacket("artnet", 0), 1) and shown(fixtures, ("artnet", 0)) == 2
    fixtures.take(data(0, 3, protocol="artnet", sequence=None), 1.1 + ARTSYNC_S)
    assert shown(fixtures, ("artnet", 0)) == 3


def test_a_short_packet_leaves_the_other_channels_dark():
    fixtures = Fixtures([ONE])
    fixtures.take(data()._replace(values=b"\x05\x06"), 0)
    assert np.array_equal(fixtures.shown[ONE][:3], [5, 6, 0])


def test_what_is_no_packet_for_fixtures_is_passed_over():
    sound = bytes.fromhex("00100000") + b"ASC-E1.17\0\0\0" + bytes.fromhex("726e00000004") + b"c" * 16 + bytes.fromhex("725800000002") \
        + b"name".ljust(64, b"\0") + bytes([100, 0, 7, 9, 0, 0, 1]) + bytes.fromhex("720b02a1000000010003") + b"\0\x01\x02"
    assert read_sacn(sound) == DataPacket("sacn", 1, b"c" * 16, 100, 9, 7, False, b"\x01\x02")
    assert read_sacn(sound[:112] + b"\x80" + sound[113:]) is None  # a preview
    assert read_sacn(sound[:125] + b"\xdd" + sound[126:]) is None  # priorities of channels
    art = b"Art-Net\0" + bytes([0, 0x50, 0, 14, 3, 0, 0x34, 0x12, 0, 2, 8, 9])
    assert read_artnet(art, "h") == DataPacket("artnet", 0x1234, b"h", 100, 3, 0, False, b"\x08\x09")
    for length in range(126):
        assert read_sacn(sound[:length]) is None
    for length in range(18):
        assert read_artnet(art[:length], "h") is None
    random = np.random.default_rng(2)
    for packet in (sound, art):
        for _ in range(2000):  # whatever a network carries, nothing is raised
            damaged = bytearray(packet[:random.integers(len(packet) + 1)] + random.bytes(4))
            damaged[random.integers(len(damaged))] = random.integers(256)
            found = (read_sacn(bytes(damaged)), read_artnet(bytes(damaged), "h"))
            for each in found:
                if each is not None:
                    Fixtures([ONE]).take(each, 0)
