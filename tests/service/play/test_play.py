"""Cues played on the loopback and received as fixtures do: every frame, whole, in order; and dark lamps at the end of everything."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import service
from service.errors import RequestError
from service.play import play as module
from service.play.play import play
from service.requests.base.options import options_of
from service.requests.play import PlayRequest, TwinRequest
from service.twin.fixtures import DataPacket, SyncPacket, read_artnet, read_sacn
from service.twin.listener import Listener
from stage.errors import ManifestError
from stage.rig.patch import levels_of_universes
from stage.rig.rig import read_rig
from tests.marks import first_short
from tests.scenes.captures import ring
from tests.scenes.patched_rigs import loopback, write_cues_file, write_rig_file

ROOT = Path(service.__file__).parents[1]
DARK_FRAMES = 4
"""One before the show, three after it."""
PAGE = Path(__file__).parents[3] / "docs" / "drive.md"
TEXT = PAGE.read_text(encoding="utf-8").partition("## Play and rehearse")[2].partition("\n## ")[0]
ELSEWHERE = {"--cache"}
"""Options that all commands with images have."""
CAMERA = {"--pictures", "--picture-format", "--faults", "--noise", "--seed"}
"""Options of the twin's camera, which docs/set.md tells."""


def counted_steps(frames: int, emitters: int) -> np.ndarray:
    """[frames, emitters] steps that tell the frame in every channel, so that a mixed frame shows."""
    return np.repeat(1 + np.arange(frames)[:, None] % 255, emitters, axis=1)


def played(folder: Path, steps: np.ndarray, lamps: int, universes: int, protocol: str, **options) -> list[np.ndarray]:
    """Play steps, and return the levels [emitters] of each whole frame that fixtures showed."""
    host = loopback()
    rig_path = write_rig_file(folder / "rig.json", ring(lamps), host=host, universes=universes, protocol=protocol)
    cues = write_cues_file(folder / "cues.json", rig_path, steps)
    rig = read_rig(rig_path)
    with Listener([(protocol, 1 + n) for n in range(universes)], host, keep=True) as listener:
        result = play(PlayRequest(cues=cues, rig=rig_path, **options))
        assert result.frames == len(steps) and not result.interrupted
        listener.wait(len(steps) + DARK_FRAMES, time.monotonic() + 5)
        assert listener.fixtures.out_of_order == 0
    return [levels_of_universes(rig, frame.values) for frame in listener.kept]


@pytest.mark.parametrize("protocol", ["sacn", "artnet"])
def test_a_show_arrives_whole_and_ends_dark(tmp_path, protocol):
    steps = np.random.default_rng(1).integers(0, 256, (5, 18))
    found = played(tmp_path, steps, 6, 2, protocol, frames_per_second=200)
    # a first ArtSync tells fixtures that packets are synchronised: two of the first dark frame come one by one, and are one frame
    assert len(found) == 5 + DARK_FRAMES
    assert np.allclose(found[1:-3], steps / 255, atol=1e-12)
    assert not any(found[n].any() for n in (0, -1, -2, -3))


@pytest.mark.long
@pytest.mark.parametrize("protocol", ["sacn", "artnet"])
def test_of_six_universes_at_40_hz_no_frame_is_lost_or_mixed(tmp_path, protocol):
    steps = counted_steps(200, 90)
    found = played(tmp_path, steps, 30, 6, protocol)
    assert len(found) == 200 + DARK_FRAMES
    assert np.array_equal(np.round(255 * np.array(found[1:-3])), steps)


def test_without_synchronisation_every_packet_is_shown_at_once(tmp_path):
    steps = counted_steps(4, 18)
    assert np.allclose(played(tmp_path, steps, 6, 2, "sacn", universe_sync=False, frames_per_second=200)[1:-3], steps / 255)


def packets_of(folder: Path, protocol: str, **options) -> list[DataPacket | SyncPacket]:
    """What leaves when two frames of two universes are played, as it arrives."""
    host = loopback()
    rig = write_rig_file(folder / "rig.json", ring(4), host="127.0.0.1", universes=2)
    cues = write_cues_file(folder / "cues.json", rig, counted_steps(2, 12))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind((host, {"sacn": 5568, "artnet": 6454}[protocol]))
        listening.settimeout(0.2)
        play(PlayRequest(cues=cues, rig=rig, protocol=protocol, host=host, frames_per_second=200, **options))
        found = []
        while True:
            try:
                data, sender = listening.recvfrom(2048)
            except TimeoutError:
                return found
            if protocol == "sacn":
                assert len(data) in (638, 49)
            found.append(read_sacn(data) if protocol == "sacn" else read_artnet(data, sender[0]))


def test_the_packets_of_sacn(tmp_path):
    found = packets_of(tmp_path, "sacn", priority=150)
    data = [packet for packet in found if isinstance(packet, DataPacket)]
    shown, ended = [p for p in data if not p.terminated], [p for p in data if p.terminated]
    assert [packet.universe for packet in shown] == [1, 2] * 6 and [packet.universe for packet in ended] == [1, 1, 1, 2, 2, 2]
    assert {packet.priority for packet in data} == {150} and len({packet.source for packet in data}) == 1
    assert {packet.sync for packet in shown} == {63999}
    assert [packet.sequence for packet in shown if packet.universe == 1] == list(range(6))
    assert found[2::3][:6] == [SyncPacket("sacn", 63999)] * 6
    assert [packet.values[0] for packet in shown[::2]] == [0, 1, 2, 0, 0, 0] and not any(any(packet.values) for packet in ended)
    plain = packets_of(tmp_path, "sacn", universe_sync=False)
    assert all(isinstance(packet, DataPacket) and packet.sync == 0 for packet in plain)


def test_the_packets_of_artnet_of_a_rig_with_sacn_addresses(tmp_path):
    found = packets_of(tmp_path, "artnet")
    assert [packet.protocol for packet in found] == ["artnet"] * 18
    assert found[2::3] == [SyncPacket("artnet", 0)] * 6
    data = [packet for packet in found if isinstance(packet, DataPacket)]
    assert [packet.universe for packet in data] == [1, 2] * 6
    assert [packet.sequence for packet in data[::2]] == [1, 2, 3, 4, 5, 6]
    assert [packet.values[0] for packet in data[::2]] == [0, 1, 2, 0, 0, 0]


def test_a_held_frame_stays_until_the_show_is_stopped(tmp_path):
    host = loopback()
    rig_path = write_rig_file(tmp_path / "rig.json", ring(2), host=host)
    cues = write_cues_file(tmp_path / "cues.json", rig_path, counted_steps(3, 6), first=16)
    stop = threading.Event()
    with Listener([("sacn", 1)], host, keep=True) as listener:
        thread = threading.Thread(target=play, args=[PlayRequest(cues=cues, rig=rig_path, hold=17), stop])
        thread.start()
        listener.wait(4, time.monotonic() + 10)
        stop.set()
        thread.join(10)
        assert not thread.is_alive()
    values = [int(frame.values["sacn", 1][0]) for frame in listener.kept]
    assert values[:4] == [0, 2, 2, 2] and set(values) == {0, 2} and values[-1] == 0


@first_short("protocol", ["sacn", "artnet"])
def test_a_slow_show_keeps_its_source_alive(tmp_path, monkeypatch, protocol):
    monkeypatch.setattr(module, "KEEP_ALIVE_S", 0.1)
    found = played(tmp_path, counted_steps(2, 12), 4, 2, protocol, frames_per_second=2)
    values = [round(255 * float(levels[0])) for levels in found]
    assert values == sorted(values[:-3]) + [0, 0, 0] and all(5 <= values.count(step) <= 7 for step in (1, 2))


@first_short("protocol", ["sacn", "artnet"])
def test_values_that_stay_are_sent_three_times(tmp_path, protocol):
    """E1.31-2018, section 6.6.2."""
    found = played(tmp_path, counted_steps(2, 12), 4, 2, protocol, frames_per_second=4)
    assert [round(255 * float(levels[0])) for levels in found][3:] == [1, 1, 1, 2, 2, 2, 0, 0, 0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("protocol", ["sacn", "artnet"])
@pytest.mark.long
def test_a_signal_turns_the_lamps_and_their_dimmers_dark(tmp_path, protocol, number):
    host = loopback()
    rig_path = write_rig_file(tmp_path / "rig.json", ring(6), host=host, universes=2, protocol=protocol, dimmer=500)
    cues = write_cues_file(tmp_path / "cues.json", rig_path, np.full((3, 18), 255))
    with Listener([(protocol, 1), (protocol, 2)], host, keep=True) as listener:
        program = subprocess.Popen([sys.executable, "-m", "service.cli.main", "play", str(cues), str(rig_path), "--loop"], cwd=ROOT,
                                   stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
        try:
            listener.wait(10, time.monotonic() + 30)
            assert levels_of_universes(read_rig(rig_path), listener.last.values).min() == 1
            program.send_signal(number)
            out, _ = program.communicate(timeout=20)
        finally:
            program.kill()  # else it would go on to light the lamps of the next test
        assert program.returncode == 0 and "the lamps are dark" in out
    assert not any(values.any() for values in listener.last.values.values())


def test_an_error_turns_the_lamps_dark(tmp_path, monkeypatch):
    host = loopback()
    rig = write_rig_file(tmp_path / "rig.json", ring(2), host=host)
    cues = write_cues_file(tmp_path / "cues.json", rig, np.full((1, 6), 255))
    monkeypatch.setattr(module, "max", lambda *_: 1 / 0, raising=False)  # at the first frame's time
    with Listener([("sacn", 1)], host, keep=True) as listener:
        with pytest.raises(ZeroDivisionError):
            play(PlayRequest(cues=cues, rig=rig))
        listener.wait(DARK_FRAMES, time.monotonic() + 5)
    assert not listener.last.values["sacn", 1].any() and listener.last.number == DARK_FRAMES


def test_the_command_says_what_was_sent(tmp_path, relit):
    rig = write_rig_file(tmp_path / "rig.json", ring(2), host=loopback())
    cues = write_cues_file(tmp_path / "cues.json", rig, counted_steps(2, 6))
    outcome = relit.done("play", cues, rig, "--fps", "200")
    assert outcome.out.splitlines()[0] == "frames   2 sent; the lamps are dark" and outcome.out.splitlines()[1].startswith("late     ")


def test_bad_input_is_one_sentence(tmp_path, relit):
    rig = write_rig_file(tmp_path / "rig.json", ring(2), host="127.0.0.1")
    cues = write_cues_file(tmp_path / "cues.json", rig, counted_steps(2, 6))
    other = write_rig_file(tmp_path / "other.json", ring(3), host="127.0.0.1")
    data = json.loads(rig.read_text())

    def changed(name: str, cues_too: bool = True, **address) -> tuple[Path, Path]:
        lights = [{**light, "address": {**light["address"], **address} if address else None} for light in data["lights"]]
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({**data, "lights": lights}))
        return write_cues_file(tmp_path / f"{name}.cues.json", path, counted_steps(2, 6)) if cues_too else cues, path

    zero = changed("zero", protocol="artnet", universe=0)
    for arguments, words in [
        ((cues, other), "the cues were made for another rig"),
        (changed("bare"), "lights[0].address: is missing"),
        (changed("manual", protocol="manual", universe=None), "no lamp has a sacn or artnet address"),
        ((cues, rig, "--hold", "9"), "--hold 9:"),
        ((cues, rig, "--host", "no.such.host.invalid"), "the host no.such.host.invalid cannot be resolved"),
        ((cues, rig, "--host", "a" * 70), "cannot be resolved"),
        ((cues, rig, "--interface", "203.0.113.9"), "--interface 203.0.113.9"),
        ((cues, rig, "--source-name", "é" * 40), "takes 80 bytes of UTF-8"),
        ((*zero, "--protocol", "sacn"), "--protocol sacn has universes 1 to 63999"),
    ]:
        outcome = relit("play", *arguments)
        assert (outcome.code, outcome.out) == (2, ""), arguments
        assert words in outcome.err
        assert outcome.err.count("\n") == (2 if "bare" in str(arguments[1]) else 1), outcome.err


def test_a_network_that_refuses_multicast_is_one_sentence(tmp_path, monkeypatch):
    rig = write_rig_file(tmp_path / "rig.json", ring(2), host=None)
    cues = write_cues_file(tmp_path / "cues.json", rig, counted_steps(2, 6))

    class Refusing(socket.socket):
        def sendto(self, data, address):
            raise OSError(101, "Network is unreachable")

    monkeypatch.setattr("service.play.outputs.socket.socket", Refusing)
    with pytest.raises(RequestError, match=r"multicast to 239\.255\.0\.1, port 5568: network is unreachable: give"):
        play(PlayRequest(cues=cues, rig=rig))
    with pytest.raises(RequestError, match=r"^the network refuses broadcast to 255\.255\.255\.255"):
        play(PlayRequest(cues=cues, rig=rig, protocol="artnet"))
    with pytest.raises(RequestError, match=r"^cannot send to 127\.0\.0\.1, port 5568: network is un"):
        play(PlayRequest(cues=cues, rig=rig, host="127.0.0.1"))


@pytest.mark.parametrize(("protocol", "package"), [("sacn", "sacn"), ("artnet", "stupidArtnet")])
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, protocol, package):
    rig = write_rig_file(tmp_path / "rig.json", ring(2), host="127.0.0.1")
    cues = write_cues_file(tmp_path / "cues.json", rig, counted_steps(2, 6))
    monkeypatch.delitem(sys.modules, f"service.play.{protocol}_output", raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(RequestError, match=r"pip install 'relit\[set\]'"):
        play(PlayRequest(cues=cues, rig=rig, protocol=protocol))


def test_two_hosts_of_one_universe_are_refused(tmp_path):
    rig = write_rig_file(tmp_path / "rig.json", ring(2), host="127.0.0.1")
    data = json.loads(rig.read_text())
    data["lights"][1]["address"]["host"] = "127.0.0.2"
    rig.write_text(json.dumps(data))
    cues = write_cues_file(tmp_path / "cues.json", rig, counted_steps(2, 6))
    with pytest.raises(ManifestError, match=r"lights\[1\]\.address\.host: is 127\.0\.0\.2"):
        play(PlayRequest(cues=cues, rig=rig))


def test_the_page_names_the_options_that_there_are():
    options = [option for model in (PlayRequest, TwinRequest) for option in options_of(model) if not option.spelling.argument]
    named = set(re.findall(r"--[a-z][a-z-]+", TEXT))
    known = {option.flag for option in options} | {option.off for option in options if option.kind is bool}
    assert named <= known
    wanted = {option.off if option.field.default is True else option.flag for option in options} - {"--device"} - ELSEWHERE
    assert wanted & set(re.findall(r"--[a-z][a-z-]+", (PAGE.parent / "set.md").read_text(encoding="utf-8"))) >= CAMERA
    assert wanted - CAMERA <= named
