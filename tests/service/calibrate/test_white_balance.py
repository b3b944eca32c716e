"""White balance from a card, and the colours of camera raw files: a card becomes grey, and colours those of the capture's space."""

import json

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.stack.correction import Correction
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, write_capture, write_exr
from tests.scenes.dng import RGGB, XYZ_TO_CAMERA, write_dng

BLACK, WHITE = (512, 520, 516, 530), 15000
ROWS, COLS = 32, 40
LIGHT = np.array([0.8, 1.0, 0.45])  # in the primaries of Rec.709
XYZ_FROM_REC709 = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])


def radiance_of(folder, index=0):
    capture = Capture.open(folder)
    return Correction.of(capture).apply(capture.manifest.frames[index]).pixels


def test_a_card_becomes_grey(relit, tmp_path):
    scene = make_scene(16, 4)
    folder = write_capture(tmp_path / "cap", scene)
    for index, image in enumerate(scene.images):
        write_exr(folder / f"{index:03d}.exr", image * LIGHT)
    card = np.full((16, 16, 3), 0.4) * LIGHT
    card[:, :4] = 0  # the table that it lies on
    outcome = relit.done("calibrate", "white-balance", folder, write_exr(tmp_path / "card.exr", card), "--region", "4,0,12,16")
    assert "gains    1.2500 red, 1.0000 green, 2.2222 blue" in outcome.out
    np.testing.assert_allclose(radiance_of(folder), scene.images[0], rtol=1e-5, atol=1e-6)  # float32, digits of the report
    assert relit("info", folder).code == 0
    outcome = relit("calibrate", "white-balance", folder, tmp_path / "card.exr", "--region", "8,8,16,16")
    assert outcome.code == 2 and "--region 8,8,16,16: leads out of the images" in outcome.err
    outcome = relit("calibrate", "white-balance", folder, tmp_path / "card.exr", "--region", "0,0,4,4")
    assert outcome.code == 2 and "card.exr: the card is dark in red, green, blue" in outcome.err
    outcome = relit("calibrate", "white-balance", folder, tmp_path / "card.exr", "--sensor-colors")
    assert outcome.code == 2 and "--sensor-colors: is about camera raw files" in outcome.err


def counts_of(rec709):
    """What a sensor with the colour matrix of the file records of one colour, [rows, cols] uint16."""
    camera_from_rec709 = np.array(XYZ_TO_CAMERA) @ XYZ_FROM_REC709
    sensor = camera_from_rec709 @ rec709
    place = 2 * (np.arange(ROWS)[:, None] % 2) + np.arange(COLS) % 2
    levels = np.array(BLACK)[place]
    return np.rint(levels + sensor[np.array(RGGB)[place]] * (WHITE - levels)).astype(np.uint16)


def test_colours_of_camera_raw_become_those_of_the_space(relit, tmp_path):
    pytest.importorskip("rawpy")
    folder = write_capture(tmp_path / "cap", make_scene(8, 3))
    edit_manifest(folder, camera={"projection": "orthographic", "resolution": [COLS, ROWS]}, mask=None)
    colours = [np.array(c) for c in ((0.4, 0.2, 0.1), (0.1, 0.3, 0.2), (0.2, 0.25, 0.4))]
    for index, colour in enumerate(colours):
        write_dng(folder / f"{index}.dng", counts_of(colour))
        edit_frame(folder, index, image=f"{index}.dng")
    write_dng(folder / "card.dng", counts_of(np.full(3, 0.5)))
    relit.done("calibrate", "white-balance", folder, folder / "card.dng")
    for index, colour in enumerate(colours):
        found = radiance_of(folder, index).mean(axis=(0, 1))
        np.testing.assert_allclose(found / found.sum(), colour / colour.sum(), atol=3e-4)  # counts, and four digits of the matrix
    balanced = json.loads((folder / "calibration.json").read_text())["white-balance"]
    assert balanced["unevenness"] == pytest.approx([0, 0, 0], abs=1e-3)
    assert relit("calibrate", "white-balance", folder, folder / "card.dng", "--sensor-colors").code == 0
    matrix = np.array(Capture.open(folder).manifest.color_matrix)
    assert np.count_nonzero(matrix - np.diag(np.diag(matrix))) == 0
    write_dng(folder / "over.dng", np.full((ROWS, COLS), WHITE, np.uint16))
    outcome = relit("calibrate", "white-balance", folder, folder / "over.dng")
    assert outcome.code == 2 and f"over.dng: {ROWS * COLS} pixels of the card are saturated" in outcome.err
    write_exr(folder / "card.exr", np.full((ROWS, COLS, 3), 0.5))
    assert "the card and the frames are to be of one kind" in relit.refused("calibrate", "white-balance", folder, folder / "card.exr")
