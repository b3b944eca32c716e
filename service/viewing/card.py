"""Two small pictures that stand for a capture in a list: one of the object, and a sheet of it under light from a grid of directions.

A list shows the first, and blends those of the sheet next to where the pointer is. A capture that cannot be relit has the first alone.
"""

from pathlib import Path

import numpy as np

from service.viewing.capture_frames import CaptureImages, fit, one_frame, white_of
from service.viewing.light_transfer import weights_of
from service.viewing.reduction import TileRow, block_sums, plane_means, put_together
from stage.capture.capture import Capture
from stage.capture.point_lights import DistantLights
from stage.colour.colour import convert
from stage.files import replacing
from stage.formats.images import write_jpeg

PICTURE_FILE, SHEET_FILE = "card.jpg", "card_lights.jpg"
SIDE, CELL = 384, 160
"""Longest sides of the picture and of those of the sheet, pixels."""
GRID = 5
"""Pictures of the sheet in each row and column: the lights are at x from −REACH to REACH and at y from REACH to −REACH, on the unit
sphere."""
REACH = 0.85
"""Directions further from the view axis, in the corners of the grid, are brought to this distance from it."""
FIRST_LIGHT = np.array([0.45, 0.5, 0.74])
"""Direction of the light of the picture: above right of the camera, as on the page that relights."""
MAT = 0x2B / 255
"""Display value of the neutral grey behind the object; `--mat` in static/look/tokens.css of the pages is the same."""
QUALITY = 85


def grid_directions() -> np.ndarray:
    """Return the directions of the sheet's lights, row by row, [GRID², 3] unit vectors."""
    line = np.linspace(-REACH, REACH, GRID)
    x, y = (plane.ravel() for plane in np.meshgrid(line, -line))
    pull = np.minimum(1, REACH / np.maximum(np.hypot(x, y), 1e-9))
    return np.stack([pull * x, pull * y, np.sqrt(1 - (pull * x) ** 2 - (pull * y) ** 2)], axis=1)


class RelitCard:
    """Sums the pictures up while the coefficient images of a basis are at hand."""

    def __init__(self, lights: DistantLights, rows: int, cols: int) -> None:
        """Take the captured lights, and the size of the coefficient images."""
        towards = np.concatenate([[FIRST_LIGHT / np.linalg.norm(FIRST_LIGHT)], grid_directions()])
        self._weights = weights_of(towards[:, None], np.ones((len(towards), 1)), lights).swapaxes(0, 1)  # [3, pictures, lights]
        self._step = -(-max(rows, cols) // SIDE)
        self._cols = cols
        self._sums = np.zeros((3 * len(towards), -(-rows // self._step), -(-cols // self._step)), dtype=np.float32)

    def add(self, row: TileRow, images: np.ndarray, matrix: np.ndarray, side: int) -> None:
        """Add a row of tiles: coefficient images [tiles, 3, terms, side²], matrices [tiles, 3, lights, terms] of the captured images."""
        pictures = np.matmul(np.matmul(self._weights, matrix), images)  # [tiles, 3, pictures, side²]
        planes = put_together(pictures.reshape(len(pictures), len(self._sums), -1), row, side, self._cols)
        columns = np.add.reduceat(planes, np.arange(0, self._cols, self._step), axis=2)
        for place, sums in zip(range(row.rows.start, row.rows.stop), columns.swapaxes(0, 1), strict=True):
            self._sums[:, place // self._step] += sums

    def write(self, folder: Path, coverage: np.ndarray, space: str) -> None:
        """Write both pictures; `coverage` [rows, cols] is that of the coefficient images, `space` their colour space."""
        shares = plane_means(coverage, self._step)
        counted = block_sums(np.ones((*coverage.shape, 1), dtype=np.float32), self._step)[..., 0]
        planes = self._sums.reshape(3, -1, *self._sums.shape[1:]) / counted
        pictures = planes.transpose(1, 2, 3, 0)  # [pictures, rows, cols, 3]
        white = white_of(pictures[0], shares > 0.5)
        shown = [encoded(picture, white, space, shares) for picture in pictures]
        write_picture(folder / PICTURE_FILE, shown[0])
        height, width = (max(1, round(CELL * side / max(shares.shape))) for side in shares.shape)
        cells = np.stack([fit(each.astype(np.float32), height, width) for each in shown[1:]])
        sheet = cells.reshape(GRID, GRID, height, width, 3).swapaxes(1, 2)
        write_picture(folder / SHEET_FILE, sheet.reshape(GRID * height, GRID * width, 3))


def write_photograph(folder: Path, capture: Capture, found: CaptureImages, mask: np.ndarray, space: str) -> None:
    """Write the brightest photograph of a capture as its picture, where there is one, and take away a sheet."""
    (folder / SHEET_FILE).unlink(missing_ok=True)
    picture = one_frame(capture, found, mask, SIDE)
    if picture is None:
        (folder / PICTURE_FILE).unlink(missing_ok=True)
        return
    radiance, coverage = picture
    white = white_of(radiance, coverage > 0.5)
    write_picture(folder / PICTURE_FILE, encoded(radiance * coverage[..., None], white, space, coverage))


def encoded(radiance: np.ndarray, white: float, space: str, coverage: np.ndarray) -> np.ndarray:
    """Return radiance [rows, cols, 3], premultiplied by the coverage [rows, cols], as display values over MAT."""
    display = convert(np.clip(radiance / white if white > 0 else radiance, 0, 1).astype(np.float32), space, "srgb_texture")
    return np.asarray(np.clip(display + MAT * (1 - coverage[..., None]), 0, 1))


def write_picture(path: Path, display: np.ndarray) -> None:
    """Write display values [rows, cols, 3] as a JPEG, complete or not at all."""
    with replacing(path) as temporary:
        write_jpeg(temporary, np.rint(255 * np.clip(display, 0, 1)).astype(np.uint8), QUALITY, subsampled=True)
