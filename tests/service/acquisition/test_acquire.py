"""Whole captures without hardware: a serial board at a pseudo-terminal, HTTP, a person, and a camera that writes files."""

import json
import os
import signal
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from unittest import mock
from urllib.parse import urlsplit

import numpy as np
import pytest

from service.acquisition.acquire import Acquisition, acquire, refuse_to_ask
from service.acquisition.cameras.watched_folder import WatchedFolder
from service.acquisition.checks.expectation import FaultKind
from service.acquisition.lights.lights import Lights
from service.errors import RequestError
from service.requests.acquire import AcquireRequest
from stage.capture.capture import Capture
from stage.errors import StageError
from stage.importers.camera_options import View
from stage.rig.rig import read_rig
from tests.scenes.captures import make_scene, ring, write_exr
from tests.scenes.patched_rigs import loopback, write_plan, write_rig_file
from tests.service.answering import Asked, answering
from tests.service.full_disk import files_of_at_most
from tests.service.twin_program import ROOT

LAMPS = 6


class Stage:
    """Lamps that can be switched, and a camera that writes into a folder what they light; `faults` are kinds by the number of a release."""

    def __init__(self, folder: Path, faults: dict[int, FaultKind] | None = None) -> None:
        self.scene, self.folder, self.faults = make_scene(size=24, lights=LAMPS), folder, faults or {}
        self.on: set[int] = set()
        self.released, self.asked = 0, []
        self.random = np.random.default_rng(1)
        self.last = None
        folder.mkdir()

    def command(self, text: str) -> None:
        word, *rest = text.split()
        self.on = set() if word == "off" else self.on | {int(rest[0])}

    def release(self) -> None:
        self.released += 1
        fault, path = self.faults.get(self.released), self.folder / f"IMG_{self.released:04d}.exr"
        pixels = 0.2 * sum((self.scene.images[lamp] for lamp in self.on), np.zeros_like(self.scene.images[0])) \
            + self.random.normal(0, 1e-3, self.scene.images[0].shape)
        if fault is FaultKind.CLIPPED:
            pixels = np.minimum(50 * pixels, 1)
        pixels = self.last if fault is FaultKind.DOUBLED else np.maximum(pixels, 0)
        if fault not in (FaultKind.LATE, FaultKind.MISSING):  # a camera that repeats itself repeats what it gave
            self.last = pixels
        if fault is FaultKind.LATE:
            threading.Timer(0.5, write_exr, [path, pixels]).start()
        elif fault is not FaultKind.MISSING:
            write_exr(path, pixels)


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """A stage whose camera is released by the program of --trigger."""
    found = Stage(tmp_path / "watch")
    monkeypatch.setattr(WatchedFolder, "_release", lambda camera, exposure: found.release())
    return found


def write_rig(path: Path, stage: Stage, protocol: str, controllers: dict | None = None) -> Path:
    path.write_text(json.dumps({"schema": "relit.rig/1", "name": "dome", "controllers": controllers or {}, "lights": [
        {"name": f"L{index}", "type": "distant", "direction": towards, "primaries": [{"name": "white", "irradiance": [1, 1, 1]}],
         "address": {"protocol": protocol}} for index, towards in enumerate(stage.scene.directions.tolist())]}))
    return path


def request(folder: Path, stage: Stage, rig: Path, **changes) -> AcquireRequest:
    if not (folder / "plan.json").exists():
        write_plan(folder, {"take": "dark"}, {"take": "olat"})
    return AcquireRequest(**{"plan": str(folder / "plan.json"), "rig": rig, "camera": f"watch:{stage.folder}",
                             "out": folder / "capture", "timeout": 0.3, **changes})


def by_hand(folder: Path, stage: Stage) -> tuple[Path, object]:
    """Return a rig whose lamps a person switches, and the person."""
    def ask(what: str) -> None:
        stage.asked.append(what)
        stage.on = {index for index in range(LAMPS) if f"L{index} " in what}
    return write_rig(folder / "rig.json", stage, "manual"), ask


@contextmanager
def controller(folder: Path, stage: Stage) -> Iterator[tuple[Path, str]]:
    """Yield a rig whose lamps a server switches, and the address of the server, at whose /shoot the camera is released."""
    def answer(asked: Asked) -> tuple[int, bytes]:
        word = asked.path.strip("/").replace("/", " ")
        stage.release() if word == "shoot" else stage.command(word)
        return 200, b""

    with answering(answer) as url:
        requests = {"on": {"url": url + "/on/{index}"}, "off": {"url": url + "/off"}}
        yield write_rig(folder / "rig.json", stage, "http", {"http": requests}), url


def posting(url: str) -> str:
    """Return the text of --trigger that posts to an address, by a program that starts soon."""
    parts = urlsplit(url)
    return (f"{sys.executable} -ISc \"import socket; s = socket.create_connection(('{parts.hostname}', {parts.port})); "
            rf"s.sendall(b'POST {parts.path} HTTP/1.0\r\n\r\n'); s.recv(9)" '"')


def check(folder: Path, stage: Stage, taken_twice: int = 0, rounds: int = 1) -> None:
    """Compare each frame with the light that its entry names, and each file with the one that came, of so many rounds of the lamps."""
    capture, lines = Capture.open(folder), [json.loads(line) for line in (folder / "acquisition.jsonl").read_text().splitlines()]
    sources = {line["file"]: line["source"] for line in lines if line.get("event") == "taken"}
    assert len(capture.manifest.frames) == len(sources) == rounds * LAMPS + 1
    for frame in capture.manifest.frames:
        assert (folder / frame.image).read_bytes() == (stage.folder / sources[frame.image]).read_bytes()
    lights = [frame.light.direction for frame in capture.manifest.frames if frame.light.type == "distant"]
    assert np.allclose(lights, np.tile(stage.scene.directions, (rounds, 1)), atol=1e-6)
    pictures = [line["shot"] for line in lines if line.get("event") == "taken"]
    assert len(pictures) == len(set(pictures)) + taken_twice


def test_by_hand_each_lamp_is_asked_for_and_a_capture_that_is_there_is_not_taken_again(tmp_path, stage):
    rig, ask = by_hand(tmp_path, stage)
    result = acquire(request(tmp_path, stage, rig), ask)
    assert result.faults == () and result.taken == LAMPS + 1
    assert all(f"L{index} " in stage.asked[index] for index in range(LAMPS))
    check(tmp_path / "capture", stage)
    assert acquire(request(tmp_path, stage, rig), ask).taken == 0


def test_lamps_that_another_capture_switches_are_refused(tmp_path):
    """Each of two captures, of different folders, took pictures under the lamps of both."""
    path = write_rig_file(tmp_path / "rig.json", ring(2), host=loopback())
    with closing(Lights(path, read_rig(path), refuse_to_ask)):
        other = write_rig_file(tmp_path / "other.json", ring(3), host=loopback())
        with pytest.raises(RequestError, match=r"other\.json: .* of sacn universe 1 at 127[.0-9]+ are switched by another capture"):
            Lights(other, read_rig(other), refuse_to_ask)
    Lights(other, read_rig(other), refuse_to_ask).close()


def test_a_serial_board_is_told_and_answers_and_is_dark_at_the_end(tmp_path, stage):
    host, board = os.openpty()
    tty.setraw(board)
    heard = []

    def answer() -> None:
        text = b""
        while not text.endswith(b"bye\n"):
            text += os.read(host, 100)
            while b"\n" in text and not text.startswith(b"bye"):
                line, text = text.split(b"\n", 1)
                heard.append(line.decode())
                stage.command(heard[-1])
                os.write(host, b"ok\n")
    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    serial = {"port": os.ttyname(board), "on": "on {index}\n", "off": "off\n", "acknowledge": "^ok", "ready_s": 0}
    rig = write_rig(tmp_path / "rig.json", stage, "serial", {"serial": serial})
    assert acquire(request(tmp_path, stage, rig), refuse_to_ask).faults == ()
    check(tmp_path / "capture", stage)
    assert heard == ["off", *(text for index in range(LAMPS) for text in (f"on {index}", "off"))]
    deaf = write_rig(tmp_path / "deaf.json", stage, "serial", {"serial": {**serial, "acknowledge": "^never", "timeout_s": 0.2}})
    with pytest.raises(RequestError, match="answers 'ok'"):
        acquire(request(tmp_path, stage, deaf, out=tmp_path / "other"), refuse_to_ask)


def test_http_lamps_are_dark_however_a_capture_ends(tmp_path, stage):
    with controller(tmp_path, stage) as (rig, _):
        stop = threading.Event()
        release = stage.release

        def stopped() -> None:
            release()
            if stage.released == 3:
                stop.set()
        stage.release = stopped
        result = acquire(request(tmp_path, stage, rig), refuse_to_ask, stop=stop)
        assert 0 < result.there < LAMPS and stage.on == set()

        def broken() -> None:
            raise RequestError("the camera is gone")
        stage.release = broken
        with pytest.raises(RequestError, match="camera is gone"):
            acquire(request(tmp_path, stage, rig, out=tmp_path / "second"), refuse_to_ask)
        assert stage.on == set()
        stage.release = release
        with files_of_at_most(600), pytest.raises(StageError):
            acquire(request(tmp_path, stage, rig, out=tmp_path / "full"), refuse_to_ask)
        assert stage.on == set() and not list((tmp_path / "full").glob("*.exr"))
        assert acquire(request(tmp_path, stage, rig), refuse_to_ask).there == LAMPS + 1
        check(tmp_path / "capture", stage)
    with pytest.raises(RequestError, match="no answer"):
        acquire(request(tmp_path, stage, rig, out=tmp_path / "third"), refuse_to_ask)


@pytest.mark.parametrize("kind", [FaultKind.DOUBLED, FaultKind.MISSING, FaultKind.LATE, FaultKind.CLIPPED])
def test_a_picture_with_a_fault_is_taken_again(tmp_path, stage, kind):
    rig, ask = by_hand(tmp_path, stage)
    stage.faults = {4: kind}
    result = acquire(request(tmp_path, stage, rig), ask)
    assert result.faults == () and kind in {fault.kind for fault in result.retaken}
    assert {fault.shot for fault in result.retaken} == {"0004_light_003"}
    check(tmp_path / "capture", stage)


def faults_at_random(folder: Path, seed: int) -> tuple[set[tuple[str, FaultKind]], set[tuple[str, FaultKind]]]:
    """Return the faults that happened at four random releases of a capture, with their shots, and those that were named; the capture has
    none at the end.

    Also those that follow one another, and those of pictures that are taken again; a late picture is missing first. A dropped one after a
    late one of the same lamp would not be missed, as the late one stands for it.
    """
    random, stage = np.random.default_rng(seed), Stage(folder / "watch")
    rig, ask = by_hand(folder, stage)
    kinds = [*random.permutation([FaultKind.DOUBLED, FaultKind.MISSING, FaultKind.CLIPPED]), FaultKind.LATE]
    places = sorted(random.permutation(np.arange(3, 9))[:4].tolist())  # the first is dark, and clips nothing
    stage.faults = dict(zip(places, map(FaultKind, kinds), strict=True))
    with mock.patch.object(WatchedFolder, "_release", lambda camera, exposure: stage.release()):
        result = acquire(request(folder, stage, rig, retakes=4), ask)
    lines = [json.loads(line) for line in (folder / "capture" / "acquisition.jsonl").read_text().splitlines()]
    released = [line["shot"] for line in lines if line.get("event") == "released"]
    made = {(released[number - 1], kind) for number, kind in stage.faults.items()}
    made |= {(shot, FaultKind.MISSING) for shot, kind in made if kind is FaultKind.LATE}
    check(folder / "capture", stage)
    return made, {(fault.shot, fault.kind) for fault in (*result.retaken, *result.faults)}


@pytest.mark.long
def test_faults_at_random_pictures_are_named_with_them_and_none_else(tmp_path):
    for seed in range(4):  # benchmarks/on_set.py takes 20
        (tmp_path / str(seed)).mkdir()
        made, named = faults_at_random(tmp_path / str(seed), seed)
        assert named == made, seed


def test_where_no_lamp_lights_the_capture_ends_after_the_second_and_goes_on_when_they_do(tmp_path, stage):
    rig, ask = by_hand(tmp_path, stage)
    given = request(tmp_path, stage, rig)
    with pytest.raises(RequestError, match=r"the same command again, with --retake 0002_light_001$"):
        acquire(given, lambda what: None)
    assert stage.released == 1 + 2 * 3  # a dark picture, and three attempts each
    assert acquire(given.model_copy(update={"retake": ("0002_light_001",)}), ask).faults == ()
    check(tmp_path / "capture", stage, taken_twice=1)


def test_a_picture_of_another_size_than_the_rigs_camera_is_refused_and_the_capture_goes_on_with_the_right_one(tmp_path, stage):
    rig, ask = by_hand(tmp_path, stage)
    right = json.loads(rig.read_text())
    rig.write_text(json.dumps({**right, "camera": View().entry((30, 24))}))
    with pytest.raises(RequestError, match=r"is 30x24, the picture IMG_0001\.exr has 24x24"):
        acquire(request(tmp_path, stage, rig), ask)
    assert not list((tmp_path / "capture").glob("*.exr")) and not (tmp_path / "capture" / "capture.json").exists()
    stage.scene = stage.scene._replace(images=np.pad(stage.scene.images, ((0, 0), (0, 0), (3, 3), (0, 0))))
    assert acquire(request(tmp_path, stage, rig), ask).there == LAMPS + 1
    check(tmp_path / "capture", stage)


@pytest.mark.long
def test_ctrl_c_ends_the_wait_for_a_person(tmp_path, stage):
    rig, _ = by_hand(tmp_path, stage)
    person, terminal = os.openpty()
    command = [sys.executable, "-m", "service.cli.main", "capture", "olat", "--rig", rig, "--camera", f"watch:{stage.folder}", "--out",
               tmp_path / "capture"]
    program = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdin=terminal, stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)
    assert "light L0" in next(line for line in program.stderr if "then press Enter" in line)
    program.send_signal(signal.SIGINT)
    said, _ = program.communicate(timeout=30)
    os.close(person)
    os.close(terminal)
    assert program.returncode == 1 and "run the same command again" in said


@pytest.mark.parametrize("after", (1, 4, 7))
def test_a_capture_goes_on_after_it_was_cut_off_at_any_picture(tmp_path, stage, monkeypatch, after):
    rig, ask = by_hand(tmp_path, stage)
    run = Acquisition(request(tmp_path, stage, rig), ask)

    def dies(shot, picture, faults):
        if stage.released == after:
            raise KeyboardInterrupt
        Acquisition._accept(run, shot, picture, faults)
    monkeypatch.setattr(run, "_accept", dies)
    with pytest.raises(KeyboardInterrupt):
        run.run()
    stage.on = set()
    acquire(request(tmp_path, stage, rig), ask)
    check(tmp_path / "capture", stage)
    assert stage.released <= LAMPS + 2  # those of the plan, and one that shows that nothing moved


def test_two_runs_do_not_take_one_capture(tmp_path, stage):
    """The second one removed unfinished files of the first, which then ended because they were not there."""
    rig, ask = by_hand(tmp_path, stage)
    first = Acquisition(request(tmp_path, stage, rig), ask)
    with pytest.raises(RequestError, match=f"^{tmp_path / 'capture'}: is being taken by another"):
        Acquisition(request(tmp_path, stage, rig), ask)
    first.run()
    check(tmp_path / "capture", stage)
    assert acquire(request(tmp_path, stage, rig), ask).taken == 0


def test_a_picture_that_is_there_is_taken_again_on_request(tmp_path, stage):
    rig, ask = by_hand(tmp_path, stage)
    acquire(request(tmp_path, stage, rig), ask)
    released, key = stage.released, "0004_light_003"
    earlier = (tmp_path / "capture" / f"{key}.exr").read_bytes()
    result = acquire(request(tmp_path, stage, rig, retake=(key,)), ask)
    assert (result.taken, result.faults, stage.released) == (1, (), released + 2)  # one shows that nothing moved
    assert (tmp_path / "capture" / "rejected" / f"{key}.0.exr").read_bytes() == earlier
    check(tmp_path / "capture", stage, taken_twice=1)
    with pytest.raises(RequestError, match="its last one is 0007_light_006"):
        acquire(request(tmp_path, stage, rig, retake=("0009_light_008",)), ask)


def test_bad_input_is_refused_with_one_sentence(tmp_path, stage):
    rig, ask = by_hand(tmp_path, stage)
    for changes, words in (({"camera": f"watch:{tmp_path}/none"}, "no such folder"), ({"camera": "film:1"}, "no kind of camera"),
                           ({"plan": "olat,moon"}, "moon"), ({"plan": "gray"}, "--projector")):
        with pytest.raises(RequestError, match=words):
            acquire(request(tmp_path, stage, rig, **changes), ask)
    acquire(request(tmp_path, stage, rig), ask)
    with pytest.raises(RequestError, match="another plan"):
        acquire(request(tmp_path, stage, rig, plan="olat"), ask)
    with pytest.raises(RequestError, match="somebody must act"):
        acquire(request(tmp_path, stage, rig, out=tmp_path / "other"), refuse_to_ask)
