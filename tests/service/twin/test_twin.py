"""The twin of a stage: what its fixtures show when packets arrive, and its camera."""

import csv
import json
import signal
import socket
import threading
import time
import urllib.request

import numpy as np
import pytest

from service.play.play import play
from service.requests.play import PlayRequest, TwinRequest
from service.twin.fixtures import ARTSYNC_S, LOSS_S, DataPacket, Fixtures, SyncPacket, read_artnet, read_sacn
from service.twin.listener import Listener
from service.twin.twin import open_twin, rehearse
from stage.formats import exr, images
from tests.scenes.captures import make_scene, ring, write_capture
from tests.scenes.patched_rigs import loopback, write_cues_file, write_rig_file
from tests.service.twin_program import twin_running

LAMPS = 6
HALF_TOLERANCE = 2e-3
"""The stack holds the images in half."""
IRRADIANCE = 0.05 + np.eye(3)
"""[primaries, channels] of the lamps of write_rig_file."""
ONE, TWO = ("sacn", 1), ("sacn", 2)


def weighted_sum(scene, levels: np.ndarray) -> np.ndarray:
    """[rows, cols, 3] float64 of levels [lamps, primaries], lamp n at light n."""
    weights = levels.astype(np.float64) @ IRRADIANCE / scene.irradiance
    return np.einsum("lrcx,lx->rcx", scene.images, weights)


@pytest.mark.parametrize(("protocol", "bits"), [("sacn", 8), ("artnet", 16)])
def test_the_picture_is_the_sum_of_images_at_the_levels_of_the_cues(tmp_path, protocol, bits):
    scene = make_scene(lights=LAMPS)
    capture = write_capture(tmp_path / "capture", scene)
    host = loopback()
    rig = write_rig_file(tmp_path / "rig.json", scene.directions, host=host, universes=2, protocol=protocol, bits=bits)
    steps = np.random.default_rng(3).integers(0, 2**bits, (4, 3 * LAMPS))
    cues = write_cues_file(tmp_path / "cues.json", rig, steps)
    request = TwinRequest(rig=rig, capture=capture, interface=host, frames=5, after=20, snapshot=tmp_path / "seen.exr",
                          record=tmp_path / "levels.csv")
    player = threading.Thread(target=play, args=[PlayRequest(cues=cues, rig=rig)])
    twin = open_twin(request)
    assert twin.picture.warnings == []
    result = rehearse(twin, request, lambda page: player.start())
    player.join()
    assert result.frames == 5
    header, *rows = csv.reader((tmp_path / "levels.csv").read_text().splitlines())
    assert header[:4] == ["frame", "time_s", "lamp 0.r", "lamp 0.g"]
    levels = np.array(rows, dtype=float)[:, 2:]
    assert np.allclose(levels[1:], steps / (2**bits - 1), atol=1e-8)  # nine digits
    channels, _ = exr.read(tmp_path / "seen.exr")
    seen = np.stack([channels[c] for c in "RGB"], axis=-1)
    truth = weighted_sum(scene, levels[-1].reshape(LAMPS, 3))
    assert np.abs(seen - truth).max() <= HALF_TOLERANCE * max(truth.max(), 1e-9)


def test_cues_that_the_twin_plays_to_itself_as_png(tmp_path):
    scene = make_scene(lights=LAMPS)
    host = loopback()
    rig = write_rig_file(tmp_path / "rig.json", scene.directions, host=host)
    cues = write_cues_file(tmp_path / "cues.json", rig, np.full((1, 3 * LAMPS), 128))
    capture = write_capture(tmp_path / "capture", scene)
    request = TwinRequest(rig=rig, capture=capture, interface=host, snapshot=tmp_path / "seen.png", frames=3, play=cues)
    assert rehearse(open_twin(request), request, lambda page: None).frames == 3
    assert not any(thread.name.startswith("relit-play") for thread in threading.enumerate())
    seen = images.read_pixels(tmp_path / "seen.png")
    assert seen[scene.mask].mean() > 2 * seen[~scene.mask].mean()


def test_a_lamp_far_from_every_captured_light_is_named(tmp_path):
    directions = ring(LAMPS)
    away = np.array([0.0, np.sin(np.radians(5)), np.cos(np.radians(5))])
    rig = write_rig_file(tmp_path / "rig.json", np.stack([away, *directions[1:]]), host="127.0.0.1")
    twin = open_twin(TwinRequest(rig=rig, capture=write_capture(tmp_path / "capture", make_scene(lights=LAMPS))))
    warning, = twin.picture.warnings
    assert "the lamp lamp 0 stands 5° from" in warning


@pytest.mark.long
def test_the_page_shows_frames_until_it_is_interrupted(tmp_path):
    scene = make_scene(lights=LAMPS)
    capture, host = write_capture(tmp_path / "capture", scene), loopback()
    rig = write_rig_file(tmp_path / "rig.json", scene.directions, host=host)
    cues = write_cues_file(tmp_path / "cues.json", rig, np.full((2, 3 * LAMPS), 255))
    with twin_running(rig, capture, host) as (program, page):
        stop = threading.Event()
        player = threading.Thread(target=play, args=[PlayRequest(cues=cues, rig=rig, loop=True), stop])
        player.start()

        def asked(path: str) -> bytes:
            with urllib.request.urlopen(page + path, timeout=20) as answer:
                return answer.read()

        ends = time.monotonic() + 20
        while (state := json.loads(asked("/state.json")))["levels"][0] != [1, 1, 1] and time.monotonic() < ends:
            time.sleep(0.05)
        assert state["levels"] == [[1, 1, 1]] * LAMPS and state["frame"] > 1
        assert asked("/picture.png?frame=3").startswith(b"\x89PNG")
        assert [lamp["name"] for lamp in json.loads(asked("/rig.json"))["lamps"]] == [f"lamp {n}" for n in range(LAMPS)]
        assert b"twin.js" in asked("/") and b"dome.js" in asked("/twin.js") and b"placeOf" in asked("/static/dome.js")
        stop.set()
        player.join()
        assert json.loads(asked("/state.json"))["levels"][0] == [0, 0, 0]
        program.send_signal(signal.SIGINT)
        out, _ = program.communicate(timeout=20)
        assert program.returncode == 0 and "received" in out


def test_bad_input_is_one_sentence(tmp_path, relit):
    capture = write_capture(tmp_path / "capture", make_scene(lights=LAMPS))
    rig = write_rig_file(tmp_path / "rig.json", ring(LAMPS), host="127.0.0.1")
    host = loopback()
    for arguments, words in [
        (["--snapshot", tmp_path / "a.jpg"], "end the name in .exr or .png"),
        (["--interface", "203.0.113.9", "--after", "1"], "--interface 203.0.113.9: cannot listen on port 5568 (sACN)"),
        (["--interface", host, "--after", "0.1", "--snapshot", tmp_path / "a.exr"], "no frame was received"),
    ]:
        outcome = relit("twin", rig, capture, *arguments)
        assert outcome.code == 2 and words in outcome.err and outcome.err.count("\n") == 1
    cues = write_cues_file(tmp_path / "cues.json", write_rig_file(tmp_path / "other.json", ring(2), host=None), np.full((1, 6), 1))
    assert "rig_digest" in relit.refused("twin", rig, capture, "--interface", host, "--play", cues)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((host, 6454))
        outcome = relit("twin", rig, capture, "--interface", host, "--after", "1")
        assert (outcome.code, outcome.err.count("\n")) == (2, 1)
        assert f"--interface {host}: cannot listen on port 6454 (Art-Net)" in outcome.err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        outcome = relit("twin", rig, capture, "--interface", host, "--port", taken.getsockname()[1])
        assert (outcome.code, outcome.err.count("\n")) == (2, 1) and "cannot serve the page" in outcome.err
    assert not list(tmp_path.glob("a.*"))


def test_the_ports_are_free_again(tmp_path):
    for _ in range(2):
        with Listener([("sacn", 1)], loopback(), keep=False):
            pass


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
