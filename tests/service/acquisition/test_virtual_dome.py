"""Captures at virtual domes by a virtual camera, whose card is full after 26 pictures, so that a capture goes on several times."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from service.acquisition.acquire import acquire, refuse_to_ask
from service.acquisition.cameras.watched_folder import WatchedFolder
from service.acquisition.checks.expectation import FaultKind
from service.errors import RequestError
from service.play.show import driven_universes
from service.requests.acquire import AcquireRequest
from service.twin.listener import Listener
from stage.capture.capture import Capture
from stage.formats import images
from stage.rig.patch import levels_of_universes
from stage.rig.rig import read_rig
from stage.transforms import fibonacci_sphere
from tests.reference.colour import srgb_to_linear
from tests.scenes.captures import Scene, make_scene, render, write_capture, write_exr
from tests.scenes.patched_rigs import loopback, write_plan
from tests.scenes.rigs import write_rig
from tests.service.acquisition.scenes import BRIGHT, VISIBLE, relief
from tests.service.acquisition.test_cameras import virtual_camera
from tests.service.twin_program import ROOT, twin_running
from tests.service.waiting import until

LAMPS = 96
FAULTS = {"dead": FaultKind.UNLIT, "wrong": FaultKind.WRONG_LIGHT, "doubled": FaultKind.DOUBLED, "moved": FaultKind.MOVED,
          "clipped": FaultKind.CLIPPED, "ambient": FaultKind.AMBIENT, "focus": FaultKind.UNSHARP}
SIZE = 48
CAPTURE = """
import json
import sys
import time
from pathlib import Path

import numpy as np

from service.acquisition.acquire import acquire, refuse_to_ask
from service.acquisition.lights.dmx import DmxSwitch
from service.errors import RequestError
from service.requests.acquire import AcquireRequest
from service.requests.play import PictureFormat, TwinRequest
from service.twin.camera import TwinCamera, card_kept
from service.twin.listener import Listener
from service.twin.twin import open_twin
from stage.rig.patch import levels_of_universes

folder, host, faults = Path(sys.argv[1]), sys.argv[2], tuple(sys.argv[3:])
request = TwinRequest(rig=folder / "rig.json", capture=folder / "scene", interface=host, pictures=folder / "card",
                      picture_format=PictureFormat.CARD, faults=faults, noise=0.004 * bool(faults))
twin = open_twin(request)
with Listener(twin.universes, host, keep=False) as listener:
    camera = TwinCamera(twin.rig, twin.picture, listener, request.pictures, request)
    send = DmxSwitch.set

    def send_and_settle(switch, levels):  # no time is long enough on every machine
        send(switch, levels)
        while True:
            frame = listener.last
            if np.array_equal(levels_of_universes(twin.rig, dict(frame.values)), levels) and camera.on_card >= frame.number:
                return
            time.sleep(0.001)

    DmxSwitch.set = send_and_settle
    with card_kept(camera):
        cards, result = 0, None
        while result is None:
            try:
                result = acquire(AcquireRequest(plan=str(folder / "plan.json"), rig=folder / "rig.json", camera="gphoto2",
                                                out=folder / "capture", retakes=0 if faults else 2), refuse_to_ask)
            except RequestError as error:
                cards += 1
                if "the card of the camera is full: empty it" not in str(error) or cards == 6:
                    raise  # the next camera has an empty one
print(json.dumps([cards, {fault.shot: fault.kind for fault in result.faults}]))
"""


def photographed(folder: Path, host: str, *faults: str) -> list:
    """Return how many cards were filled by a capture of the twin with faults, and the faults that were named, by shots.

    The package finds the virtual camera by the environment in which its process starts.
    """
    done = subprocess.run([sys.executable, "-c", CAPTURE, str(folder), host, *faults], env=virtual_camera(folder / "card"),
                          capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def shown_lamps(scene: Scene, capture: Path) -> list[int]:
    """Return the lamp of the scene whose light each picture of a capture is nearest to."""
    codes = np.array([images.read_pixels(capture / frame.image) for frame in Capture.open(capture).manifest.frames], dtype=np.float64)
    return [int(np.abs(scene.images - each).mean(axis=(1, 2, 3)).argmin()) for each in srgb_to_linear(codes)]


@pytest.mark.long
def test_a_dome_of_96_and_a_virtual_camera(tmp_path, relit):
    """Each picture is that of its lamp, and what is solved of them is what is solved of the same files when they are imported."""
    scene = make_scene(size=SIZE)
    directions, light = fibonacci_sphere(220)[:LAMPS], np.ones((LAMPS, 3))  # none below 7 degrees, where the cap is nearly dark
    scene = scene._replace(directions=directions, irradiance=light, images=render(scene.normal, scene.albedo, directions, light))
    write_capture(tmp_path / "scene", scene)
    write_rig(tmp_path / "rig.json", directions, {"white": (1.0, 1.0, 1.0)}, host=(host := loopback()))
    write_plan(tmp_path, {"take": "olat"})
    (tmp_path / "card").mkdir()
    cards, faults = photographed(tmp_path, host)
    assert cards >= 2 and faults == {}
    capture, imported = tmp_path / "capture", tmp_path / "imported"
    frames = json.loads((capture / "capture.json").read_text())["frames"]
    towards = np.array([frame["light"]["direction"] for frame in frames])
    assert np.array_equal((towards @ directions.T).argmax(axis=1), np.arange(LAMPS))
    assert shown_lamps(scene, capture) == list(range(LAMPS))
    rows = [" ".join([frame["image"], *map(repr, frame["light"]["direction"])]) for frame in frames]
    (capture / "dome.lp").write_text("\n".join([str(LAMPS), *rows]))
    relit.done("import", "lp", capture / "dome.lp", imported, "--color-space", "srgb_texture")
    for folder in (capture, imported):
        relit.done("solve", folder, "--method", "lambert", "--out", folder / "maps")
    maps = [OpenEXR.File(str(folder / "maps" / "maps.exr"), separate_channels=True).channels() for folder in (capture, imported)]
    assert maps[0].keys() == maps[1].keys()
    for name, channel in maps[0].items():
        assert np.array_equal(channel.pixels, maps[1][name].pixels, equal_nan=True), name


@pytest.mark.long
@pytest.mark.parametrize(("seed", "protocol"), [(1, "sacn"), (2, "artnet")])
def test_faults_on_the_card_are_named_with_their_pictures_and_none_else(tmp_path, seed, protocol):
    scene = relief(seed, (10, 8, 5))
    count, random = len(scene.directions), np.random.default_rng(seed)
    light, even = scene.radiance.mean(axis=(1, 2, 3)), np.ones((count, 3))
    pictures = make_scene()._replace(directions=scene.directions, irradiance=even, images=scene.radiance,
                                     mask=np.ones(scene.radiance.shape[1:3], bool))
    write_capture(tmp_path / "scene", pictures)
    write_rig(tmp_path / "rig.json", scene.directions, {"white": (1.0, 1.0, 1.0)}, host=(host := loopback()), protocol=protocol)
    write_plan(tmp_path, {"take": "dark"}, {"take": "olat"})
    (tmp_path / "card").mkdir()
    made: dict[int, str] = {}
    for fault in FAULTS:
        made[int(random.choice([lamp for lamp in range(1, count) if not {lamp - 1, lamp, lamp + 1} & made.keys()
                                and VISIBLE < light[lamp] / light.mean() < BRIGHT]))] = fault
    words = [f"{fault}@{lamp + 1}" for lamp, fault in made.items()]
    wanted = {f"{lamp + 2:04d}_light_{lamp + 1:03d}": FAULTS[fault] for lamp, fault in made.items()}  # a dark picture is the first
    assert photographed(tmp_path, host, *words) == [0, wanted]


@pytest.mark.parametrize("protocol", ["sacn", "artnet"])
@pytest.mark.parametrize("ends", ["error", "ctrl-c"])
def test_lamps_over_dmx_are_dark_after_an_error_and_after_ctrl_c(tmp_path, monkeypatch, protocol, ends):
    scene, path, watched, host = make_scene(size=24, lights=6), tmp_path / "rig.json", tmp_path / "watched", loopback()
    write_rig(path, scene.directions, {"white": (1.0, 1.0, 1.0)}, host=host, protocol=protocol)
    watched.mkdir()
    rig, seen = read_rig(path), []

    def lit() -> np.ndarray:
        return levels_of_universes(rig, dict(listener.last.values)).nonzero()[0]

    def release(camera, exposure_s):
        lamp = len(seen)
        until(lambda: list(lit()) == [lamp], "the lamp was not heard of")
        seen.append(lamp)
        if lamp == 2 and ends == "error":
            raise RequestError("the camera is gone")
        write_exr(watched / f"{lamp}.exr", scene.images[lamp])
        if lamp == 2:
            signal.raise_signal(signal.SIGINT)
    monkeypatch.setattr(WatchedFolder, "_release", release)
    given = AcquireRequest(plan="olat", rig=path, camera=f"watch:{watched}", out=tmp_path / "capture")
    with Listener(driven_universes(path, rig), host, keep=False) as listener:
        if ends == "error":
            with pytest.raises(RequestError, match="camera is gone"):
                acquire(given, refuse_to_ask)
        else:
            assert acquire(given, refuse_to_ask).there == 3
        until(lambda: not lit().size, "a lamp stays lit")
    assert seen == [0, 1, 2]


@pytest.mark.long
def test_the_commands_take_the_pictures_of_a_virtual_camera(tmp_path):
    """As docs/set.md has them; a picture that came before its lamp would be one of another lamp, or doubled, and is taken again."""
    lamps, card, host = 9, tmp_path / "card", loopback()
    scene, light = make_scene(size=SIZE, lights=lamps), np.ones((lamps, 3))
    scene = scene._replace(irradiance=light, images=render(scene.normal, scene.albedo, scene.directions, light))
    write_capture(tmp_path / "scene", scene)
    write_rig(tmp_path / "rig.json", scene.directions, {"white": (1.0, 1.0, 1.0)}, host=host)
    plan = write_plan(tmp_path, {"take": "olat"}, settle_s=0.5)
    with twin_running(tmp_path / "rig.json", tmp_path / "scene", host, "--pictures", card, "--picture-format", "card", "--cache", tmp_path):
        until(lambda: any(card.glob("*")), "the card has no picture")
        subprocess.run([sys.executable, "-m", "service.cli.main", "capture", plan, "--rig", tmp_path / "rig.json", "--camera", "gphoto2",
                        "--out", tmp_path / "capture", "--retakes", "20"], check=True, cwd=ROOT, env=virtual_camera(card))
    assert shown_lamps(scene, tmp_path / "capture") == list(range(lamps))


def test_a_card_cannot_lose_a_picture(tmp_path, relit):
    """The sentence says which fault."""
    write_capture(tmp_path / "scene")
    write_rig(tmp_path / "rig.json", make_scene().directions, host="127.0.0.1")
    words = relit.refused("twin", tmp_path / "rig.json", tmp_path / "scene", "--pictures", tmp_path / "card", "--picture-format", "card",
                          "--faults", "dead@3,late@4")
    assert "--faults late" in words
