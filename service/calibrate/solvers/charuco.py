"""The corners of a printed board in an image: of a chessboard, which must be seen whole, or of a ChArUco board, of which a part is enough.

The markers in the white squares of a ChArUco board say which of its corners are seen. They also say whether the board is the declared one:
where their centres lie tells its layout, and their sides relative to the squares tell the sizes. The scale of both together they do not
tell.

Source: Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial markers under occlusion", Pattern Recognition
    47(6), 2014 (markers and boards, as OpenCV finds them).
"""

from typing import NamedTuple

import cv2
import numpy as np

from service.calibrate.solvers.procam import SADDLE_OF_SPACING, eight_bits, find_corners, refined
from service.requests.calibrate import BoardOptions, LaserPlanesOptions

DICTIONARIES = {
    "aruco4": cv2.aruco.DICT_4X4_1000, "aruco5": cv2.aruco.DICT_5X5_1000, "aruco6": cv2.aruco.DICT_6X6_1000,
    "aruco7": cv2.aruco.DICT_7X7_1000, "apriltag16h5": cv2.aruco.DICT_APRILTAG_16h5, "apriltag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "apriltag36h11": cv2.aruco.DICT_APRILTAG_36h11}
"""The sets of markers; a smaller ArUco set of the same grid is the beginning of that with 1000."""
LEAST_MARKERS = 4
"""The fewest markers whose centres place a board."""
SMALL_PX = 30.0
"""Side of markers in pixels, below which they are looked for in the image at twice its size too: OpenCV reads 4 to 8 of 35 markers of 12
pixels, and 23 to 31 of them so."""
LEAST_INNER = 3
"""The fewest inner corners across and down of a board that OpenCV finds."""
LEAST_SEEN = 8
"""The fewest corners of a view: their positions on the board then hold its pose twice over."""
PLACE_OF_SQUARE = 0.25
"""A marker farther from its place, in squares, is not where the layout has it: a lens bends a board by less, another layout by whole
squares."""
LEAST_PLACED = 0.8
"""The part of the markers that must lie where the layout has them; the others may be misread."""
SIDE_PART, SIDE_PX = 0.05, 1.0
"""How far the side of the markers may lie from the declared one: relative to it, and in pixels beside that, which edges are good to."""


class Charuco(NamedTuple):
    """What is printed in the white squares of a board."""

    dictionary: str
    side: float  # of a marker, in squares


def charuco_of(options: BoardOptions | LaserPlanesOptions) -> Charuco | None:
    """Return what the options say of markers; None for a plain chessboard."""
    if options.markers is None or options.marker_m is None or options.square_m is None:
        return None
    return Charuco(str(options.markers), options.marker_m / options.square_m)


def find_board(image: np.ndarray, board: tuple[int, int], charuco: Charuco | None) -> np.ndarray | str:
    """Return the inner corners of a board in an image, or a sentence that says why there are none.
    `image`: [rows, cols] float32, linear, evenly lit. Returns [corners, 2] image coordinates, row by row of the board; NaN where a corner
    of a ChArUco board is not seen."""
    if charuco is not None:
        return _find_charuco(eight_bits(image), board, charuco)
    corners = find_corners(image, board)
    if corners is not None:
        return corners
    missing, inner = f"the board of {board[0]}x{board[1]} inner corners is not found", (board[0] - 1, board[1] - 1)
    if min(inner) < LEAST_INNER or find_corners(image, inner) is None:
        return missing
    return f"{missing}, but one of {inner[0]}x{inner[1]} is: --board counts inner corners, one fewer than squares"


def _find_charuco(shown: np.ndarray, board: tuple[int, int], charuco: Charuco) -> np.ndarray | str:
    name = f"{board[0]}x{board[1]} inner corners"
    found, numbers = _markers(shown, charuco.dictionary)
    if len(numbers) < LEAST_MARKERS:
        seen = {other: len(_markers(shown, other)[1]) for other in DICTIONARIES if other != charuco.dictionary}
        most = max(seen, key=lambda other: seen[other])
        said = f"the board shows {len(numbers)} markers of {charuco.dictionary}"
        if seen[most] >= LEAST_MARKERS:
            return f"{said} and {seen[most]} of {most}: give --markers {most}"
        return f"{said}, fewer than {LEAST_MARKERS}"
    centres = found.mean(axis=1)
    spread = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)[1] / len(centres)**0.5
    if spread < PLACE_OF_SQUARE * np.median(np.linalg.norm(found[:, 0] - found[:, 1], axis=1)):
        return f"the {len(numbers)} markers that are seen lie in one line, which places no board: show two rows of them or more"
    # OpenCV before 4.6 began boards of an even count of rows with a white square
    layouts = [_layout(board, charuco, legacy) for legacy in (False, True)]
    placed = [_placed(found, numbers, layout) for layout in layouts]
    layout, (on_board, right) = max(zip(layouts, placed, strict=True), key=lambda one: int(one[1][1].sum()))
    if right.sum() < max(LEAST_PLACED * len(numbers), LEAST_MARKERS):
        return (f"{int(right.sum())} of {len(numbers)} markers lie where a ChArUco board of {name} has them: count the corners again, "
                "across and down")
    sides = np.linalg.norm(on_board[right] - np.roll(on_board[right], 1, axis=1), axis=-1)  # in squares
    side_px = float(np.median(np.linalg.norm(found[right] - np.roll(found[right], 1, axis=1), axis=-1)))
    side = float(np.median(sides))
    if abs(side / charuco.side - 1) > SIDE_PART + SIDE_PX / side_px:
        return (f"the markers are {side:.3g} of a square wide, and --marker-m and --square-m say {charuco.side:.3g}: measure both on the "
                "print")
    corners, indices, _, _ = cv2.aruco.CharucoDetector(layout).detectBoard(
        shown, markerCorners=[np.asarray(one, np.float32)[None] for one in found], markerIds=numbers.astype(np.int32)[:, None])
    kept = np.zeros(0, int) if indices is None else np.ravel(indices)
    if not holds_a_pose(kept, board):
        return f"{len(kept)} corners of the ChArUco board of {name} are seen: {LEAST_SEEN} in two rows and columns or more are needed"
    every = np.full((board[0] * board[1], 2), np.nan)
    every[kept] = np.asarray(corners, np.float64).reshape(-1, 2)
    # the window of a corner must end before the markers beside it
    return refined(shown, every, board, min(SADDLE_OF_SPACING, (1 - charuco.side) / 2))


def holds_a_pose(seen: np.ndarray, board: tuple[int, int]) -> bool:
    """Return whether corners of a board, by their numbers along rows, hold its pose: two rows and two columns have two or more of them,
    since a row and one corner beside it leave the pose nearly open."""
    return len(seen) >= LEAST_SEEN and all((np.bincount(lines) >= 2).sum() >= 2 for lines in (seen // board[0], seen % board[0]))


def marker_detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    """Return the finder of the markers of one of DICTIONARIES, whose corners it refines."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]), parameters)


def _markers(shown: np.ndarray, dictionary: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [markers, 4, 2] of the markers in an image, in OpenCV's pixels, and their numbers [markers]."""
    detector = marker_detector(dictionary)
    best = np.zeros((0, 4, 2)), np.zeros(0, int)
    for times in (1, 2):
        enlarged = shown if times == 1 else cv2.resize(shown, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
        found, numbers, _ = detector.detectMarkers(enlarged)
        if numbers is not None and len(numbers) > len(best[1]):
            best = (np.array(found, np.float64).reshape(-1, 4, 2) - (times - 1) / 2) / times, np.ravel(numbers)
        if len(best[1]) >= LEAST_MARKERS and np.median(np.linalg.norm(best[0][:, 0] - best[0][:, 1], axis=1)) > SMALL_PX:
            break
    return best


def _layout(board: tuple[int, int], charuco: Charuco, legacy: bool) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's board, whose unit is a square."""
    layout = cv2.aruco.CharucoBoard((board[0] + 1, board[1] + 1), 1.0, charuco.side,
                                    cv2.aruco.getPredefinedDictionary(DICTIONARIES[charuco.dictionary]))
    layout.setLegacyPattern(legacy)
    return layout


def _placed(found: np.ndarray, numbers: np.ndarray, layout: cv2.aruco.CharucoBoard) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the markers on the board, [markers, 4, 2] in squares, and which markers lie where the layout has them."""
    centres = {int(number): np.mean(np.asarray(corners), axis=0)[:2]
               for number, corners in zip(np.ravel(layout.getIds()), layout.getObjPoints(), strict=True)}
    known = np.array([int(number) in centres for number in numbers])
    if known.sum() < LEAST_MARKERS:
        return np.zeros_like(found), np.zeros(len(numbers), bool)
    there = np.array([centres[int(number)] for number in numbers[known]])
    matrix, _ = cv2.findHomography(found[known].mean(axis=1), there, cv2.RANSAC, PLACE_OF_SQUARE)
    if matrix is None:
        return np.zeros_like(found), np.zeros(len(numbers), bool)
    on_board = cv2.perspectiveTransform(found.reshape(-1, 1, 2), matrix).reshape(found.shape)
    right = known.copy()
    right[known] = np.linalg.norm(on_board[known].mean(axis=1) - there, axis=1) < PLACE_OF_SQUARE
    return on_board, right
