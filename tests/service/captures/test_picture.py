"""relit info --picture: lights where they stand, those that disagree in red; frames in their order; mask, saturation and histogram."""

import numpy as np
import OpenImageIO as oiio
import pytest

from service.captures.capture_picture import BINS, REACH, RED, SIZE, TILE
from service.captures.info import inspect
from service.relight.sheet import GAP, MARGIN, TITLE
from service.requests.captures import InfoRequest
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, write_capture, write_exr, write_image, write_manifest
from tests.service.recording import Recording

SCENE = make_scene(size=48, lights=12)
TOP, LEFT = MARGIN + TITLE, MARGIN
BELOW, BESIDE = TOP + SIZE + GAP + TITLE, LEFT + SIZE + GAP
"""Where the first row and column of panels begin, and the second ones."""


def drawn(folder, path):
    """The facts of a capture, and its picture as [rows, cols, 3] 0…1."""
    recording = Recording()
    found = inspect(InfoRequest(capture=folder, picture=path), recording)
    assert recording.faults == []
    return found, oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)[..., :3]


def red(image):
    """[rows, cols] bool: pixels in the red of suspects."""
    return np.abs(image - RED).max(axis=-1) < 0.02


def frames_of_lights(image):
    """The rows and columns of the solid red frames on the dome: 4 pixels wide, as no letter is."""
    lines = np.lib.stride_tricks.sliding_window_view(red(image[TOP:TOP + SIZE, LEFT:LEFT + SIZE]), (4, 4)).all(axis=(2, 3))
    return np.argwhere(lines)


@pytest.mark.long
def test_a_light_that_disagrees_is_red_where_it_stands(tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    found, image = drawn(tmp_path / "cap", tmp_path / "a.png")
    assert found.faults == found.findings == [] and dict(found.facts)["picture"] == str(tmp_path / "a.png")
    assert not len(frames_of_lights(image))
    # light 4 stands 30 degrees off the axis: declared 45 degrees off it, to the lower left
    direction = np.array([-1, -1, np.sqrt(2)]) / 2
    edit_frame(tmp_path / "cap", 4, light={"type": "distant", "direction": direction.tolist(), "irradiance": SCENE.irradiance[4].tolist()})
    found, image = drawn(tmp_path / "cap", tmp_path / "b.png")
    (finding,) = found.findings
    assert finding.startswith("frames[].light: readings disagree with ")
    assert "in 004.exr (by " in finding and found.faults == []  # a suspicion
    places = frames_of_lights(image)
    row, col = (places.min(axis=0) + places.max(axis=0) + 3) / 2 - SIZE / 2
    assert np.degrees(np.arctan2(-row, col)) == pytest.approx(-135, abs=1)
    assert np.hypot(row, col) == pytest.approx(REACH, abs=4)  # that of the widest light


def test_the_lights_are_where_the_camera_sees_them(tmp_path):
    """A light to the right, and its image, are on the right; one above is above."""
    dark = np.zeros((8, 8, 3))
    write_capture(tmp_path / "cap", make_scene(size=8, lights=4))
    for index, way in enumerate(([0, 0, 1], [1, 0, 1], [0, 1, 1], [-1, 0, 1])):
        edit_frame(tmp_path / "cap", index, light={"type": "distant", "direction": way, "irradiance": [1, 1, 1]})
        write_exr(tmp_path / "cap" / f"{index:03d}.exr", dark)
    write_exr(tmp_path / "cap" / "001.exr", dark + [0, 1, 0])
    write_exr(tmp_path / "cap" / "002.exr", dark + [0, 0, 1])
    _, image = drawn(tmp_path / "cap", tmp_path / "a.png")
    dome = image[TOP:TOP + SIZE, LEFT:LEFT + SIZE]
    green, blue = (np.argwhere(dome[..., channel] > dome[..., other] + 0.2) - SIZE / 2 for channel, other in ((1, 2), (2, 1)))
    assert abs(green[:, 0].mean()) < 3 and green[:, 1].mean() == pytest.approx(REACH, abs=3)
    assert abs(blue[:, 1].mean()) < 3 and blue[:, 0].mean() == pytest.approx(-REACH, abs=3)


@pytest.mark.long
def test_saturation_is_red_where_it_is(tmp_path):
    write_capture(tmp_path / "cap", SCENE, saturation=10.0)
    whole = SCENE.images[0].copy()
    whole[20:28, 24:32] = 20.0
    write_exr(tmp_path / "cap" / "000.exr", whole)
    _, image = drawn(tmp_path / "cap", tmp_path / "a.png")
    panel = image[BELOW:BELOW + SIZE, LEFT:LEFT + SIZE]
    strong = (panel[..., 0] > panel[..., 1] + 0.3) & (panel[..., 0] > panel[..., 2] + 0.3)
    (top, left), (bottom, right) = np.argwhere(strong).min(axis=0), np.argwhere(strong).max(axis=0)
    assert (top, left, bottom, right) == pytest.approx(np.array([20, 24, 28, 32]) * SIZE / 48, abs=SIZE / 48)
    edit_manifest(tmp_path / "cap", saturation=30.0)
    _, image = drawn(tmp_path / "cap", tmp_path / "b.png")
    panel = image[BELOW:BELOW + SIZE, LEFT:LEFT + SIZE]
    assert not ((panel[..., 0] > panel[..., 1] + 0.3) & (panel[..., 0] > panel[..., 2] + 0.3)).any()


@pytest.mark.long
def test_frames_without_directions_are_in_their_order(tmp_path):
    """Patterns; one that cannot be read is crossed in red. Titles are cut to the width, but not what tells them apart."""
    codes = [{"code": "gray", "axis": "column", "bit": i, "bits": 4} for i in range(4)]
    frames = [{"image": f"{'begins-alike' * 4}{i}.exr", "pattern": codes[i]} for i in range(4)]
    for i in range(4):
        write_exr(tmp_path / "cap" / frames[i]["image"], np.full((12, 16, 3), 0.2 * (i + 1)))
    write_manifest(tmp_path / "cap", {"schema": "relit.capture/1", "name": "scan", "frames": frames,
                                      "camera": {"projection": "orthographic", "resolution": [16, 12]}})
    found, image = drawn(tmp_path / "cap", tmp_path / "a.png")
    assert found.faults == [] and not red(image).any()
    row, width = MARGIN + TITLE + TILE + GAP + TITLE + TILE // 2, TILE * 16 // 12 + GAP
    levels = [image[row, MARGIN + number * width + TILE // 2, 0] for number in range(4)]
    titles = [image[row - TILE // 2 - TITLE:row - TILE // 2, MARGIN + number * width:][:, :width].tobytes() for number in range(4)]
    assert len(set(titles)) == 4
    assert levels == sorted(levels) and len(set(levels)) == 4
    write_exr(tmp_path / "cap" / frames[2]["image"], np.full((12, 16, 3), np.nan))
    found, image = drawn(tmp_path / "cap", tmp_path / "b.png")
    assert len(found.faults) == 1 and "2.exr" in found.faults[0]
    crossed = np.argwhere(red(image))
    assert crossed[:, 1].min() >= MARGIN + 2 * width and crossed[:, 1].max() < MARGIN + 3 * width  # the third of four


def test_what_is_refused(relit, tmp_path):
    folder = write_capture(tmp_path / "cap", SCENE)
    outcome = relit("info", folder, "--picture", tmp_path / "a.jpg")
    assert outcome == (2, "", f"relit: --picture: {tmp_path}/a.jpg is no PNG: end the name in .png\n")
    before = (folder / "mask.png").read_bytes()
    relit("info", folder, "--picture", folder / "mask.png").refused("mask.png is an input: choose another folder or name")
    assert (folder / "mask.png").read_bytes() == before
    write_image(folder / "mask.png", np.zeros((48, 48), np.uint8))
    outcome = relit("info", folder, "--picture", tmp_path / "a.png")
    assert outcome.code == 2 and "picture      none: " in outcome.out and "mask is empty" in outcome.err
    assert not (tmp_path / "a.png").exists()


@pytest.mark.long
def test_the_histogram_has_every_reading(tmp_path):
    """Readings of one value are one bar, four stops above the middle of those a sixteenth as large."""
    folder = write_capture(tmp_path / "cap", make_scene(size=8, lights=4))
    for index in range(4):
        write_exr(folder / f"{index:03d}.exr", np.full((8, 8, 3), (0.6, 0.0375)[index % 2]))
    _, image = drawn(folder, tmp_path / "a.png")
    bars = image[BELOW:BELOW + SIZE, BESIDE:BESIDE + SIZE].min(axis=-1) > 0.5
    lit = np.flatnonzero(bars.sum(axis=0) > 100)
    groups = np.split(lit, np.flatnonzero(np.diff(lit) > 1) + 1)
    assert len(groups) == 2
    assert groups[1].mean() - groups[0].mean() == pytest.approx(4 * 4 * SIZE / BINS, abs=1.5)  # four bins a stop
