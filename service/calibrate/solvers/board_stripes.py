"""What a capture shows of a chessboard under a laser: its corners, and the stripe of each laser frame on it."""

from typing import NamedTuple

import cv2
import numpy as np

from service.calibrate.solvers.charuco import Charuco, find_board
from service.calibrate.solvers.laser_plane import inside_board
from service.calibrate.solvers.procam import SADDLE_OF_SPACING, eight_bits, refined
from service.calibrate.solvers.step_stripe import best_line
from service.calibrate.solvers.target_stripes import SeenStripe, even_light, find_stripes, laser_frames, uniform, whole_stripes
from service.depth.laser.stripes import stripe_signal
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.colour.colour import GREY_WEIGHTS
from stage.errors import CalibrationError, ManifestError
from stage.stack.correction import Correction

LEAST_LINES = 10
"""The fewest lines of the image on which a board shows a stripe: it counts as much as any other board."""
STRAIGHT_PX = 3.0
"""Pixels by which a stripe may leave its straight line on a board, which is bent by a few millimetres at most."""
DOUBLED, BRIGHTER = 0.25, 1.5
"""Part of the points of a stripe from which on others that lie on a line of their own are a second one, and how much brighter, for the same
albedo, one of the two is to be taken for the laser, and the other for its reflection."""
ASIDE_PX, MOVED_SIGMAS, LEAST_SEEN = 0.5, 3.0, 0.5
"""Pixels by which corners of a frame may lie beside the common move of all, how far that move is beyond its standard errors to count, and
the part of the corners that must share it."""


class BoardStripe(NamedTuple):
    """The stripe of a laser frame on a board."""

    u: np.ndarray  # [n] image coordinates, none where it is not seen
    v: np.ndarray  # [n]
    corners: np.ndarray
    """Image coordinates [corners, 2] of the board's corners in this frame, NaN where one is not seen."""
    lost: str = ""
    """Why it says nothing of its plane though it is seen."""


class BoardView(NamedTuple):
    """What a capture shows of a board."""

    corners: np.ndarray  # [corners, 2] image coordinates in the frame without the laser, NaN where one is not seen
    stripes: list[BoardStripe]
    """That of each laser frame."""
    moved_px: float
    """The largest move (RMS of the corners) of the board since the frame without the laser."""


def view_board(capture: Capture, board: tuple[int, int], charuco: Charuco | None, device: str) -> BoardView:
    """Return where a board and the stripes on it are seen. `board`: its inner corners across and down.
    Raises CalibrationError or ManifestError where a frame without the laser, or the board in it, is missing."""
    correction = Correction.of(capture)
    grey, black = even_light(capture, correction), uniform(capture, correction, "black")
    if grey is None:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: none shows the board without the laser: add one under a white "
                            'projection, or under the light of the room, {"type": "off"}')
    corners = find_board(grey, board, charuco)
    if isinstance(corners, str):
        raise CalibrationError(f"{capture.folder}: {corners}")
    inside = inside_board(corners, board, grey.shape)
    room = np.zeros((*grey.shape, 3), np.float32) if correction.ambient is None else correction.ambient
    dark = room if black is None else room + black
    # squares would shift the middle of a stripe that runs along their edges: it is divided by what the board looks like
    albedo = np.where(inside, np.maximum(grey, 0), 0).astype(np.float32)
    places, moves, albedos, masks, stripes = [], [], [], [], []
    for frame in laser_frames(capture):
        lit = correction.apply(frame).pixels + room
        way = _move(corners, np.asarray(lit @ np.array(GREY_WEIGHTS, np.float32)), grey, board)
        there, mask, beside = albedo, inside, dark
        if way is not None:
            there, mask, beside = (_moved(image, way) for image in (albedo, inside.astype(np.float32), dark))
            mask = mask > 1 - 1e-6
        places.append(corners if way is None else corners @ way[:, :2].T + way[:, 2])
        moves.append(float(np.sqrt(np.nanmean(((places[-1] - corners)**2).sum(axis=1)))))
        albedos.append(np.where(mask, there, 0).astype(np.float32))
        masks.append(mask)
        stripes.append(find_stripes(stripe_signal(lit - beside, mask), albedos[-1], device))
    brighter = [max(pair, key=lambda seen: float(seen.peak.sum())) for pair in whole_stripes(stripes, masks)]
    return BoardView(corners, [_stripe(*each, capture) for each in zip(brighter, places, albedos, strict=True)],
                     max(moves, default=0.0))


def _move(corners: np.ndarray, lit: np.ndarray, grey: np.ndarray, board: tuple[int, int]) -> np.ndarray | None:
    """Return the affine map [2, 3] of image coordinates to those of a laser frame in which the board lies elsewhere; None where it does
    not, or where the frame does not show it. `lit`, `grey`: [rows, cols] the frame, and that without the laser."""
    shown = [refined(eight_bits(image), corners - 0.5, board, SADDLE_OF_SPACING)
             for image in (grey, np.minimum(lit, np.percentile(grey, 99.5)))]
    here, there = (places[np.isfinite(shown[0] + shown[1]).all(axis=1)] for places in shown)
    way, near = cv2.estimateAffine2D(here, there, ransacReprojThreshold=ASIDE_PX)
    if way is None or near.sum() < LEAST_SEEN * len(here):
        return None
    kept = near.ravel().astype(bool)
    now = here[kept] @ way[:, :2].T + way[:, 2]
    size, noise = (float(np.sqrt((off**2).sum(axis=1).mean())) for off in (now - here[kept], now - there[kept]))
    return np.asarray(way) if size > MOVED_SIGMAS * noise * (3 / kept.sum())**0.5 else None  # an affine map goes through three points


def _moved(image: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Return an image [rows, cols] or [rows, cols, 3] moved by an affine map of image coordinates."""
    middles = way.copy()
    middles[:, 2] += 0.5 * (way[:, 0] + way[:, 1]) - 0.5  # OpenCV counts from the middle of a pixel
    return np.asarray(cv2.warpAffine(image, middles, image.shape[1::-1], flags=cv2.INTER_LINEAR))


def _stripe(seen: SeenStripe, corners: np.ndarray, albedo: np.ndarray, capture: Capture) -> BoardStripe:
    """Return the stripe without points beside its line, as of light of other surfaces; of two the one that is brighter for its albedo."""
    none = BoardStripe(np.zeros(0), np.zeros(0), corners)
    assert capture.camera.focal_px is not None
    tolerance, left = STRAIGHT_PX / max(capture.camera.focal_px), seen
    lines: list[SeenStripe] = []
    while len(lines) < 2 and len(left.lines) >= LEAST_LINES:
        own = best_line(np.stack(capture.camera.plane_at(*left.image()), axis=1), tolerance, np.random.default_rng(0))[1]
        lines.append(left.where(own))
        left = left.where(~own)
    lines = [line for line in lines if len(line.lines) >= max(LEAST_LINES, DOUBLED * len(lines[0].lines))]
    if not lines:
        return none
    lines.sort(key=lambda line: _light(line, albedo))
    if len(lines) > 1 and _light(lines[1], albedo) < BRIGHTER * _light(lines[0], albedo):
        return none._replace(lost="two stripes are about as bright: cover what reflects the laser, and expose for less where it clips")
    return BoardStripe(*lines[-1].image(), corners)


def _light(seen: SeenStripe, albedo: np.ndarray) -> float:
    """Return how bright a stripe is, as a part of its albedo."""
    column, row = (place.astype(int) for place in seen.image())
    return float(np.median(seen.peak / np.maximum(albedo[row, column], 1e-12)))
