"""Projectors that are declared wrongly under patterns of one axis, which no residual tells: said, and no depth is believed."""

import json

import numpy as np
import pytest

from tests.scenes.captures import edit_manifest
from tests.scenes.depth import BLACK_WHITE, POSE, PROJECTOR, entries_of, entry_of, gray_patterns, make_scene, phase_patterns, write_patterns

PHASE = [*phase_patterns("column", 16.0), *gray_patterns("column", stripe=8), *BLACK_WHITE]


def measured(relit, folder, **changes):
    """The depth and the warnings under a projector that is declared with changes."""
    projector = {**entry_of(PROJECTOR), "camera_from_projector": POSE.tolist()} | changes
    edit_manifest(folder, projector={name: value for name, value in projector.items() if value is not None})
    maps, report, _ = relit.depth(folder, "--device", "cpu", code=None)
    return maps, report["warnings"]


@pytest.fixture
def capture(tmp_path):
    """The sphere before the plane under columns, by waves that stripes number."""
    return write_patterns(tmp_path / "scene", make_scene(), PHASE, noise=0.001)


def test_a_right_projector_is_believed(relit, capture):
    maps, warnings = measured(relit, capture)
    assert maps.mask.mean() > 0.8 and warnings == []


@pytest.mark.parametrize(("changes", "words"), [
    ({"camera_from_projector": np.linalg.inv(POSE).tolist()}, "do if it is the inverse: give the pose of the projector in the camera"),
    ({"focal_px": [2 * PROJECTOR.focal] * 2}, "% of the pixels that the projector lights see nothing that lies in its image"),
], ids=["inverse", "focal length"])
def test_a_wrong_projector_is_named(relit, capture, changes, words):
    """The inverse gave 97 % of the pixels a depth, 28 cm off, and twice the focal length 46 cm."""
    maps, warnings = measured(relit, capture, **changes)
    assert warnings[0].startswith("projector.camera_from_projector: as declared, ") and words in warnings[0]
    assert not maps.mask.any()


def test_exchanged_bits_of_a_binary_code_are_named(relit, tmp_path):
    """A plain binary code in which dark and bright are exchanged is a mirrored one: only the geometry tells it."""
    shown = [pattern | {"code": "binary"} for pattern in gray_patterns("column") if pattern["inverse"]]
    folder = write_patterns(tmp_path / "scene", make_scene(), [*shown, *BLACK_WHITE], noise=0.001)
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    declared = entries_of([*(pattern | {"inverse": False} for pattern in shown), *BLACK_WHITE])
    edit_manifest(folder, frames=[frame | entry for frame, entry in zip(frames, declared, strict=True)])
    maps, warnings = measured(relit, folder)
    assert "mirrored" in warnings[0] and not maps.mask.any()


def test_a_missing_principal_point_is_said(relit, capture):
    """One axis cannot tell it. It is the middle of the image nearly, so that depths stay."""
    maps, warnings = measured(relit, capture, principal_px=None)
    assert warnings == ["projector.principal_px: is missing, and the middle of its image is taken, which patterns of one axis cannot "
                        "confirm: give it (relit calibrate procam measures it)"]
    assert maps.mask.mean() > 0.8


def test_intrinsics_of_another_size_are_said(relit, capture):
    _, warnings = measured(relit, capture, focal_px=[PROJECTOR.focal / 2] * 2, principal_px=(PROJECTOR.principal / 2).tolist())
    assert any(sentence.startswith("projector.principal_px: the calibration is of images of 128x96 px") for sentence in warnings), warnings
