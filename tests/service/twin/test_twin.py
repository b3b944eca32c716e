"""The way from cues over the network to the picture: against a weighted sum of the images in float64."""

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

import service
from service.play.play import play
from service.requests.play import PlayRequest, TwinRequest
from service.twin.listener import Listener
from service.twin.twin import open_twin, rehearse
from stage.formats import exr, images
from tests.scenes.captures import make_scene, ring, write_capture
from tests.scenes.patched_rigs import loopback, write_cues_file, write_rig_file

ROOT = Path(service.__file__).parents[1]
LAMPS = 6
HALF_TOLERANCE = 2e-3
"""The stack holds the images in half."""
IRRADIANCE = 0.05 + np.eye(3)
"""[primaries, channels] of the lamps of write_rig_file."""


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
    assert twin.picture.warnings == ["the lamp lamp 0 stands 5° from the nearest captured light, whose image stands for it"]


def test_the_page_shows_frames_until_it_is_interrupted(tmp_path):
    scene = make_scene(lights=LAMPS)
    capture, host = write_capture(tmp_path / "capture", scene), loopback()
    rig = write_rig_file(tmp_path / "rig.json", scene.directions, host=host)
    cues = write_cues_file(tmp_path / "cues.json", rig, np.full((2, 3 * LAMPS), 255))
    command = [sys.executable, "-m", "service.cli.main", "twin", rig, capture, "--interface", host, "--port", "0"]
    program = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        assert program.stdout.readline() == f"twin     listens on {host} for sACN and Art-Net\n"
        page = program.stdout.readline().split()[1].removesuffix(":")
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
    finally:
        program.kill()


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
        assert f"--interface {host}: cannot listen on port 6454 (Art-Net): address already in use" in outcome.err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        outcome = relit("twin", rig, capture, "--interface", host, "--port", taken.getsockname()[1])
        assert (outcome.code, outcome.err.count("\n")) == (2, 1) and "cannot serve the page" in outcome.err
    assert not list(tmp_path.glob("a.*"))


def test_the_ports_are_free_again(tmp_path):
    for _ in range(2):
        with Listener([("sacn", 1)], loopback(), keep=False):
            pass
