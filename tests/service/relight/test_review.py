"""Pictures for review are shown through the view and the looks that are asked for, by every command that makes one."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest

from service.acquisition.early_ingest import write_preview
from service.acquisition.meter import zebra
from service.relight import sheet
from service.reporting.progress import Timings
from service.requests.play import TwinRequest
from service.twin.camera import TwinPicture
from stage.capture.capture import Capture
from stage.colour.colour_spaces import Review
from stage.formats import exr, images
from stage.rig.rig import read_rig
from stage.transforms import fibonacci_sphere
from tests.scenes.captures import make_scene, rgb, write_capture, write_exr
from tests.scenes.chart import picture, shoot
from tests.scenes.patched_rigs import write_rig_file
from tests.scenes.rigs import write_rig
from tests.service.calibrate.test_chart import POSE, seen
from tests.stage.colour.test_configuration import minimal

WANTED = Review("Un-tone-mapped", "ACES 1.3 Reference Gamut Compression")
OPTIONS = ("--view", WANTED.view, "--look", WANTED.look)
SCENE = make_scene(size=12, lights=5)
KEYS = {"schema": "relit.keys/1", "captured": [{"image": "000.exr", "keys": [{"frame": 1, "weight": 1}]}]}


@pytest.fixture
def reviews(monkeypatch) -> list[Review]:
    """The views and looks through which colours were shown."""
    asked, through = [], sheet.through_view

    def told(pixels, space, review):
        asked.append(review)
        return through(pixels, space, review)

    monkeypatch.setattr(sheet, "through_view", told)
    return asked


@pytest.fixture
def capture(tmp_path):
    (tmp_path / "keys.json").write_text(json.dumps(KEYS))
    return write_capture(tmp_path / "cap", SCENE)


@pytest.mark.long
def test_the_pictures_of_commands_have_the_view_and_the_look(relit, reviews, capture, tmp_path):
    write_rig(tmp_path / "rig.json", fibonacci_sphere(32))
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3), np.float32))
    image = Capture.open(capture).manifest.frames[0].image
    (tmp_path / "keys.json").write_text(json.dumps(KEYS).replace("000.exr", image))
    chart = shoot(tmp_path / "chart", [picture(seen(), POSE).pixels])
    for command in (
            ("relight", capture, "--keys", tmp_path / "keys.json", "--out", tmp_path / "f" / "a.#.exr", "--sheet", tmp_path / "s.png"),
            ("info", capture, "--picture", tmp_path / "i.png"),
            ("drive", tmp_path / "rig.json", "--environment", tmp_path / "sky.exr", "--out", tmp_path / "cues"),
            ("calibrate", "chart", chart)):
        relit.done(*command, *OPTIONS)
        assert reviews and set(reviews) == {WANTED}, command
        reviews.clear()


def test_the_pictures_of_the_stage_have_them_too(reviews, tmp_path):
    scene = make_scene(size=24, lights=8)
    folder = write_capture(tmp_path / "cap", scene)
    rig = write_rig_file(tmp_path / "rig.json", scene.directions, host="127.0.0.1")
    twin = TwinPicture(read_rig(rig), TwinRequest(rig=rig, capture=folder, view=WANTED.view, look=WANTED.look), Timings(None))
    twin.write(tmp_path / "seen.png", np.ones(3 * 8))
    zebra(np.full((4, 4, 3), 0.5, np.float32), "lin_rec709_scene", 1.0, WANTED)
    write_preview(folder, "cpu", review=WANTED)
    assert len(reviews) >= 3 and set(reviews) == {WANTED}


def test_the_background_of_a_sheet_is_behind_what_the_matte_leaves(tmp_path):
    """Lossy compression leaves traces around an object, which were shown as black blocks; black that is covered is black. The frame has the
    height of a tile, so that nothing is resampled; one code of 8 bits."""
    frame = np.zeros((sheet.FRAME_TILE, 4, 4), np.float32)
    frame[:, 0, :3], frame[:, 1, 3], frame[:, 2, 3] = 1e-5, 1, 0.5
    sheet.contact_sheet(tmp_path / "s.png", [write_exr(tmp_path / "a.exr", frame)])
    shown = oiio.ImageBuf(str(tmp_path / "s.png")).get_pixels(oiio.FLOAT)[sheet.MARGIN + sheet.TITLE + 1, sheet.MARGIN:][:4]
    wanted = np.array([[1], [0], [0.5], [1]]) * sheet.BACKGROUND
    np.testing.assert_allclose(shown, wanted, atol=1 / 255)


def test_a_look_of_a_studios_configuration_is_in_the_sheet(relit, capture, tmp_path):
    """Half of the light of a look in closed form: 0.5 to the power of 1 / 2.5 of the values on the sheet."""
    config, image = minimal(tmp_path / "house.ocio"), Capture.open(capture).manifest.frames[0].image
    (tmp_path / "keys.json").write_text(json.dumps(KEYS).replace("000.exr", image))
    shown = {}
    for look in ("cold, -cold", "cold"):
        relit.done("relight", capture, "--keys", tmp_path / "keys.json", "--out", tmp_path / "f" / "a.#.exr", "--sheet", tmp_path / "s.png",
                   "--ocio", config, "--view", "Wall/Plain", "--look", look)
        shown[look] = images.read_pixels(tmp_path / "s.png").astype(float)
    plain, cold = shown.values()
    changed = (np.abs(plain - cold).max(axis=-1) > 0) & (plain.min(axis=-1) > 0.2) & (plain.max(axis=-1) < 1)
    assert changed.sum() > 100
    # codes of 8 bits, at least 50 of them, and edges between the object and the background, which are blended after the display
    assert np.median(cold[changed] / plain[changed]) == pytest.approx(0.5**0.4, rel=0.01)


@pytest.mark.parametrize(("command", "place"), [("relight", "minimal"), ("shade", "minimal"), ("relight", "ocio://default")])
def test_display_frames_are_the_frames_through_the_view_and_the_look(relit, capture, tmp_path, command, place):
    """The minimal configuration in closed form: the look's half of the light, to the power of 1 / 2.5; the other by OpenColorIO."""
    plain = place == "minimal"
    options = ("--ocio", minimal(tmp_path / "house.ocio"), "--view", "Wall/Plain", "--look", "cold") if plain else (
        "--view", "Display P3 - Display/Un-tone-mapped")
    if command == "relight":
        image = Capture.open(capture).manifest.frames[0].image
        (tmp_path / "keys.json").write_text(json.dumps(KEYS).replace("000.exr", image))
        made = ("relight", capture, "--keys", tmp_path / "keys.json", "--out", tmp_path / "f" / "a.#.exr", "--frames", "1-2",
                "--color-space", "hl" if plain else "ACEScg", "--display", tmp_path / "shown" / "a.##.png")
        pairs = [(tmp_path / "f" / f"a.{number}.exr", tmp_path / "shown" / f"a.0{number}.png") for number in (1, 2)]
    else:
        relit.done("solve", capture, "--out", tmp_path / "maps", "--method", "lambert")
        made = ("shade", tmp_path / "maps", "--light", "0,0,50,3000,2000,1000", "--out", tmp_path / "a.exr", "--color-space", "hl",
                "--display", tmp_path / "a.png")
        pairs = [(tmp_path / "a.exr", tmp_path / "a.png")]
    assert "display " in relit.done(*made, *options).out
    (tmp_path / "shown" / "a.01.png").unlink(missing_ok=True)
    relit.done(*made, *options)  # of frames that are there already too
    for frame, shown in pairs:
        linear = rgb(frame).astype(np.float32)
        if plain:
            wanted = np.clip(linear / 2, 0, None) ** 0.4
        else:
            wanted = oiio.ImageBufAlgo.ociodisplay(oiio.ImageBuf(linear), "Display P3 - Display", "Un-tone-mapped", "ACEScg",
                                                   colorconfig=str(place)).get_pixels(oiio.FLOAT)
        np.testing.assert_allclose(images.read_pixels(shown), np.clip(wanted, 0, 1), atol=0.51 / 255 + 1e-4)  # 8 bits; OpenColorIO's powers
        assert linear.max() > 0.1
        written, texts = exr.read(frame)[1], oiio.ImageBuf(str(shown)).spec()
        for name in ("relit:ocio", "relit:ocio_cache_id"):
            assert texts.getattribute(name) == written[name] != ""


@pytest.mark.parametrize(("command", "options", "words"), [
    ("relight", ("--look", "warm", "--sheet", "s.png"), "--look: warm is no look of the OpenColorIO configuration ocio://default: give"),
    ("relight", ("--look", "ACES 1.3 Reference Gamut Compression"),
     "is for the picture of --sheet or --display: give --sheet or --display too"),
    ("relight", ("--display", "a.png"), "--display a.png: the file name needs one run of # for the frame number, such as frame.####.png"),
    ("relight", ("--display", "a.#.exr"), "--display a.#.exr: frames are PNG here: end the name in .png"),
    ("info", ("--view", "Nice", "--picture", "i.png"), "--view: Nice is no view of the OpenColorIO configuration ocio://default: give"),
    ("info", ("--view", "Un-tone-mapped"), "is for the picture of --picture: give --picture too")])
def test_what_is_wrong_is_one_sentence(relit, capture, tmp_path, command, options, words):
    more = ("--keys", tmp_path / "keys.json", "--out", tmp_path / "f" / "a.#.exr") if command == "relight" else ()
    assert words in relit.refused(command, capture, *more, *options)
    assert not (tmp_path / "f").exists()
