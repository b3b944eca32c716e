"""A real Gray-code capture beside OpenCV's own decode of it, where it is at hand: in the folder named by RELIT_TEST_DATA."""

import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from kernels.status import Status
from kernels.structured.binary import decode_gray
from kernels.structured.confirm import confirm_stripes
from kernels.structured.pattern_frames import NoiseModel, upload
from stage.patterns.binary import binary_patterns
from stage.patterns.codes import collect

EIGHT_BIT = NoiseModel(0.003, 1.0e-4)
"""Noise of an ordinary camera of eight bits whose pixels hold ten thousand electrons, as parts of full scale."""

DATA = Path(os.environ.get("RELIT_TEST_DATA", "nowhere")) / "graycode_chessboard"
PROJECTOR = (1024, 768)

pytestmark = [pytest.mark.long, pytest.mark.skipif(not DATA.is_dir(), reason=f"no Gray-code capture in {DATA} (RELIT_TEST_DATA)")]


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    """[frames, rows, cols] float32: fractions of full scale, in OpenCV's order."""
    read = [oiio.ImageBuf(str(DATA / f"graycode_{index:02d}.png")).get_pixels(oiio.FLOAT)[..., 0] for index in range(42)]
    return np.stack(read).astype(np.float32)


@pytest.mark.parametrize("axis, number", [("column", 0), ("row", 1)])
def test_opencvs_decode_is_ours(axis, number, images, device):
    patterns = [*binary_patterns(PROJECTOR[0], "column", references=False), *binary_patterns(PROJECTOR[1], "row")]
    found = collect(patterns)
    code, = (code for code in found.codes if code.axis == axis)
    frames = upload(images.reshape(len(images), -1), device=device)
    decoded = decode_gray(frames, code.frames, code.inverses, white=found.white, black=found.black, extent=PROJECTOR[number],
                          noise=EIGHT_BIT)
    count = images[0].size
    coordinate, status = decoded.coordinate.numpy()[:count], decoded.status.numpy()[:count]
    theirs = np.load(DATA / "opencv_projxy.npz")["projxy"][..., number].ravel() + 0.5  # OpenCV counts pixels, we measure from the edge
    solved = np.isfinite(theirs)
    both = solved & (status == Status.OK)
    assert both.sum() >= 0.9 * solved.sum()
    assert (np.abs(coordinate - theirs)[both] <= 1).mean() >= 0.995


def test_black_squares_of_the_board_are_decoded(images, device):
    """The board is flat: what is decoded on it lies on one homography, up to the lens and the two finest bits (4 px); a wrong bit beyond
    these is 8 px and more away."""
    import cv2

    found = collect([*binary_patterns(PROJECTOR[0], "column", references=False), *binary_patterns(PROJECTOR[1], "row")])
    frames = upload(images.reshape(len(images), -1), device=device)
    shape = images[0].shape
    board = np.s_[97:388, 118:482]
    before, after, places = [], [], []
    for code, extent in zip(found.codes, PROJECTOR, strict=True):
        plain = decode_gray(frames, code.frames, code.inverses, white=found.white, black=found.black, extent=extent, noise=EIGHT_BIT)
        sure = confirm_stripes(plain, frames, code.frames, code.inverses, columns=shape[1], noise=EIGHT_BIT)
        for decoded, kept in ((plain, before), (sure, after)):
            kept.append(decoded.status.numpy()[:images[0].size].reshape(shape)[board] == Status.OK)
        places.append(sure.coordinate.numpy()[:images[0].size].reshape(shape)[board])
    first, last = np.logical_and(*before), np.logical_and(*after)
    assert first.mean() < 0.82 and last.mean() > 0.97  # what no surface confirms, and what one does
    y, x = np.mgrid[:shape[0], :shape[1]] + 0.5
    here, there = np.stack([x[board], y[board]], axis=-1), np.stack(places, axis=-1).astype(np.float64)
    matrix, _ = cv2.findHomography(here[first], there[first], cv2.RANSAC, 2.0)
    seen = cv2.perspectiveTransform(here[None].reshape(1, -1, 2), matrix).reshape(there.shape)
    assert np.abs(there - seen)[last].max() < 8
