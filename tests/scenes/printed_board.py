"""Boards with printed solder paste, whose good ones differ as prints do: an S-shaped warp, paste with a texture, pads a little thick or
displaced, and a sensor whose noise neighbours share, with outliers, one or two together, and missing pixels, most behind walls.

It has nothing in common with tests/scenes/board.py but the files that it writes.
"""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from tests.scenes.board import write_depth

PIXEL, SIGMA = 1.2e-5, 1.5e-6
COLS, ROWS = 300, 216
PADS = [((0.84 * (i - 1.5)) * 1e-3, (0.82 * (j - 1)) * 1e-3) for j in range(3) for i in range(4)]
"""Middles of the pads."""
PASTE, THICK, FLANK = (3.6e-4, 4.8e-4), 1.1e-4, 2.5e-5
"""Width and height of the paste of a pad, its thickness, and half the width of its flanks."""


class Print(NamedTuple):
    """What a print and its board are like; lengths in metres."""

    missing: tuple[int, ...] = ()
    """Pads without paste."""
    shift: tuple[int, float] | None = None
    """A pad and by how far its paste lies to the right."""
    volume: tuple[int, float] | None = None
    """A pad and the factor of its thickness."""
    bridge: tuple[int, int] | None = None
    """Two pads side by side that paste connects."""
    warp: float = 0.0
    """Half the height of an S along the board."""
    spread: float = 0.0
    """Standard deviation of the thickness of pads, a part of it; pads are displaced by 100 µm times this."""
    texture: float = 0.0
    """Standard deviation of the surface of paste."""
    square: tuple[float, float, float] | None = None
    """x, y and height of a square of 6 pixels."""


def surface(what: Print, rng: np.random.Generator | None = None) -> np.ndarray:
    """Heights [ROWS, COLS], metres, at pixel centres; without a generator nothing is random."""
    x, y = (np.arange(COLS) + 0.5 - COLS / 2) * PIXEL, (ROWS / 2 - np.arange(ROWS) - 0.5) * PIXEL
    x, y = np.meshgrid(x, y)
    height = 1.8e-5 * (np.abs(y - 4.1e-4 - 0.1 * x) < 5e-5)  # a trace of copper
    rough = np.zeros((ROWS, COLS)) if rng is None else gaussian_filter(rng.standard_normal((ROWS, COLS)), 1.7, mode="wrap")
    rough *= what.texture / max(rough.std(), 1e-30)
    for number, (px, py) in enumerate(PADS):
        if number in what.missing:
            continue
        thick = THICK * (1 if what.volume is None or what.volume[0] != number else what.volume[1])
        if rng is not None:
            thick *= 1 if what.volume is not None and what.volume[0] == number else 1 + what.spread * rng.standard_normal()
            px, py = px + 1e-4 * what.spread * rng.standard_normal(), py + 1e-4 * what.spread * rng.standard_normal()
        if what.shift is not None and what.shift[0] == number:
            px += what.shift[1]
        inside = np.minimum(PASTE[0] / 2 - np.abs(x - px), PASTE[1] / 2 - np.abs(y - py))
        ramp = np.clip(inside / FLANK / 2 + 0.5, 0, 1)
        height = np.maximum(height, ramp * ramp * (3 - 2 * ramp) * (thick + rough))
    if what.bridge is not None:
        (ax, ay), (bx, _) = (PADS[number] for number in what.bridge)
        height = np.where((x > ax) & (x < bx) & (np.abs(y - ay) < 6e-5), np.maximum(height, 5e-5), height)
    if what.square is not None:
        sx, sy, high = what.square
        height = height + high * ((np.abs(x - sx) < 3 * PIXEL) & (np.abs(y - sy) < 3 * PIXEL))
    return height + what.warp * np.sin(2 * np.pi * (x / x.max() / 2 + 0.07 * y / y.max()))


def measured(height: np.ndarray, rng: np.random.Generator, *, outliers: float = 0.01, lost: float = 0.002) -> np.ndarray:
    """Heights as a sensor has them: half the variance of its noise is shared by neighbours; some are NaN."""
    shared = gaussian_filter(rng.standard_normal(height.shape), 1.2, mode="wrap")
    seen = height + SIGMA * (np.sqrt(0.5) * rng.standard_normal(height.shape) + np.sqrt(0.5) * shared / shared.std())
    bad = rng.random(height.shape) < outliers * 0.8
    bad |= np.roll(bad, 1, axis=1) & (rng.random(height.shape) < 0.25)
    seen = np.where(bad, seen + 10 * SIGMA * rng.choice([-1.0, 1.0], height.shape), seen)
    wall = np.hypot(*np.gradient(height)) > 0.5 * PIXEL
    return np.where(rng.random(height.shape) < np.where(wall, 5 * lost, lost / 2), np.nan, seen)


def write_board(folder: Path, height: np.ndarray) -> Path:
    """The folder of a board of one tile, by its heights."""
    write_depth(folder / "tile" / "depth.exr", height, sigma=SIGMA, pixel=PIXEL)
    (folder / "board.json").write_text(json.dumps({"schema": "relit.board-scan/1", "name": "print", "stage_sigma_m": PIXEL,
                                                   "tiles": [{"path": "tile", "position_m": [0.0, 0.0]}]}))
    return folder


def regions(tolerance: float) -> list[dict]:
    """Tolerance regions of the pads, within their flanks, that allow a part of the thickness."""
    return [{"name": f"pad {number}", "shape": "rectangle", "centre_m": place, "size_m": [PASTE[0] - 6e-5, PASTE[1] - 6e-5],
             "tolerance_m": [-tolerance * THICK, tolerance * THICK]} for number, place in enumerate(PADS)]
