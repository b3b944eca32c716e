"""relit info --picture: lights where they stand, those that disagree in red; frames in their order; mask, saturation and histogram."""

import numpy as np
import OpenImageIO as oiio
import pytest

from service.captures.inspect import inspect
from service.captures.picture import MARGIN, REACH, RED, SIDE, SIZE
from service.requests.captures import InfoRequest
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, write_capture, write_exr, write_image, write_manifest
from tests.service.recording import Recording

SCENE = make_scene(size=48, lights=12)
BESIDE = SIZE + 2 * MARGIN
"""Where what stands beside the dome begins."""


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
    solid = red(image)[:, :BESIDE]
    lines = np.lib.stride_tricks.sliding_window_view(solid, (4, 4)).all(axis=(2, 3))
    return np.argwhere(lines)


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
    top, left = MARGIN + 20 + SIZE / 2, MARGIN + SIZE / 2
    row, col = (places.min(axis=0) + places.max(axis=0) + 3) / 2 - (top, left)
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
    dome = image[MARGIN + 20 : MARGIN + 20 + SIZE, MARGIN : MARGIN + SIZE]
    green, blue = (np.argwhere(dome[..., channel] > dome[..., other] + 0.2) - SIZE / 2 for channel, other in ((1, 2), (2, 1)))
    assert abs(green[:, 0].mean()) < 3 and green[:, 1].mean() == pytest.approx(REACH, abs=3)
    assert abs(blue[:, 1].mean()) < 3 and blue[:, 0].mean() == pytest.approx(-REACH, abs=3)


def test_saturation_is_red_where_it_is(tmp_path):
    write_capture(tmp_path / "cap", SCENE, saturation=10.0)
    whole = SCENE.images[0].copy()
    whole[20:28, 24:32] = 20.0
    write_exr(tmp_path / "cap" / "000.exr", whole)
    _, image = drawn(tmp_path / "cap", tmp_path / "a.png")
    column = image[:, BESIDE:]
    strong = (column[..., 0] > column[..., 1] + 0.15) & (column[..., 0] > column[..., 2] + 0.15)
    rows = np.flatnonzero(strong[SIZE // 3 : 2 * SIZE // 3].sum(axis=1) > 20) + SIZE // 3
    assert len(rows) > 30
    cols = np.flatnonzero(strong[rows].any(axis=0))
    share = (cols.max() - cols.min()) / (rows.max() - rows.min())
    assert share == pytest.approx(1, abs=0.15)  # a square of eight pixels
    edit_manifest(tmp_path / "cap", saturation=30.0)
    _, image = drawn(tmp_path / "cap", tmp_path / "b.png")
    column = image[SIZE // 3 : 2 * SIZE // 3, BESIDE:]
    assert not ((column[..., 0] > column[..., 1] + 0.3) & (column[..., 0] > column[..., 2] + 0.3)).any()


def test_frames_without_directions_are_in_their_order(tmp_path):
    """Patterns; one that cannot be read is crossed in red, and the fault is named below."""
    frames = [{"image": f"{i}.exr", "pattern": {"code": "gray", "axis": "column", "bit": i, "bits": 4}} for i in range(4)]
    for i in range(4):
        write_exr(tmp_path / "cap" / f"{i}.exr", np.full((12, 16, 3), 0.2 * (i + 1)))
    write_manifest(tmp_path / "cap", {"schema": "relit.capture/1", "name": "scan", "frames": frames,
                                      "camera": {"projection": "orthographic", "resolution": [16, 12]}})
    found, image = drawn(tmp_path / "cap", tmp_path / "a.png")
    assert found.faults == [] and not red(image).any()
    rows, cols = (MARGIN + 100, MARGIN + 100 + SIZE // 2), (MARGIN + 100, MARGIN + 100 + SIZE // 2)
    levels = [image[row, col, 0] for row in rows for col in cols]
    assert levels == sorted(levels) and len(set(levels)) == 4
    write_exr(tmp_path / "cap" / "2.exr", np.full((12, 16, 3), np.nan))
    found, image = drawn(tmp_path / "cap", tmp_path / "b.png")
    assert len(found.faults) == 1 and "2.exr" in found.faults[0]
    crossed = np.argwhere(red(image[: SIZE + MARGIN]))
    assert crossed[:, 0].min() > MARGIN + SIZE // 3 and crossed[:, 1].max() < MARGIN + SIZE // 2  # the third of four


def test_what_is_refused(relit, tmp_path):
    folder = write_capture(tmp_path / "cap", SCENE)
    outcome = relit("info", folder, "--picture", tmp_path / "a.jpg")
    assert outcome == (2, "", f"relit: --picture: {tmp_path}/a.jpg is no PNG: end the name in .png\n")
    before = (folder / "mask.png").read_bytes()
    outcome = relit("info", folder, "--picture", folder / "mask.png")
    assert outcome.code == 2 and "mask.png is an input: choose another folder or name" in outcome.err
    assert (folder / "mask.png").read_bytes() == before
    write_image(folder / "mask.png", np.zeros((48, 48), np.uint8))
    outcome = relit("info", folder, "--picture", tmp_path / "a.png")
    assert outcome.code == 2 and "picture      none: " in outcome.out and "mask is empty" in outcome.err
    assert not (tmp_path / "a.png").exists()


def test_the_histogram_has_every_reading(tmp_path):
    """Readings of one value are one bar, four stops above the middle of those a sixteenth as large."""
    folder = write_capture(tmp_path / "cap", make_scene(size=8, lights=4))
    for index in range(4):
        write_exr(folder / f"{index:03d}.exr", np.full((8, 8, 3), (0.6, 0.0375)[index % 2]))
    _, image = drawn(folder, tmp_path / "a.png")
    bars = image[2 * SIZE // 3 + 60 : SIZE, BESIDE : BESIDE + SIDE].min(axis=-1) > 0.5
    lit = np.flatnonzero(bars.sum(axis=0) > 100)
    groups = np.split(lit, np.flatnonzero(np.diff(lit) > 1) + 1)
    assert len(groups) == 2
    assert groups[1].mean() - groups[0].mean() == pytest.approx(4 * 4 * SIDE / 96, abs=1.5)  # four bins a stop, 96 bins
