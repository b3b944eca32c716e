"""Ranges of a scene that is turned inside out, told by the brightness and the shape of its surfaces.

Where phases run backwards, or bins are counted from the last, a plane has the range of a constant less its own. Seen along diverging lines
of sight that is no plane: it bends by the constant times the square of the angle over two, everywhere, and whatever its texture is.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from service.depth.tof.phase_checks import misread_direction

CELLS, LEAST_CELLS = 6, 18
"""Number of cells in each direction of a block in which a surface is fitted, and of those that must have ranges."""
FIRST_BLOCKS, MOST_BLOCKS = 2, 16
"""Least and largest number of blocks in each direction of an image: a block that no surface fits is divided into four."""
SURE_BEND = 0.08
"""Largest standard deviation of a block's bend, over that of a reversed plane, with which it tells one from a plane."""
FLAT = 0.2
"""Largest bend, over that of a reversed plane, of what passes for a plane; the bends of the two are 1 apart."""
STEEPEST, FLATTEST = -6.0, -0.5
"""Powers of the distance with which light falls over the surfaces of a block: -3 over a plane, and more on either side for textures."""
LEAST_AREA, PLANES, TIMES = 0.1, 0.5, 4.0
"""Least part of the image that tells; least part of it that is plane if ranges are reversed, and how many times what is as declared."""


class _Block(NamedTuple):
    area: float
    """Part of the image."""
    bends: np.ndarray  # [2] of a surface as declared, along two directions, over that of a reversed plane
    reversed_bends: np.ndarray  # [2] if ranges are reversed
    falls: float
    far: float
    """Sums over the cells of changes of the logarithm of the reversed range, times those of the brightness, and squared."""


class Reversal(NamedTuple):
    """How ranges come to run backwards."""

    field: str
    cause: str
    check: str


PHASES = Reversal("frames[].tof.reference_phase_rad", "the phases ran backwards",
                  "check the order of the images, and the sign of reference_phase_rad")
BINS = Reversal("frames[].image", "the last bin of the histograms were the nearest", "check the order of the bins in the file")


def turned_inside_out(range_m: np.ndarray, reversed_m: np.ndarray, amplitude: np.ndarray, sure: np.ndarray, rays: np.ndarray | None, *,
                      repeat_m: float, reversal: Reversal) -> str | None:
    """Return that ranges look reversed, as a sentence; None where they do not. The arguments are those of `misread_shape`; `rays`: None
    where lines of sight are parallel, and the brightness alone tells it."""
    told = misread_direction(range_m, reversed_m, amplitude, sure)
    if told is None and rays is not None:
        told = misread_shape(range_m, reversed_m, amplitude, sure, rays, repeat_m=repeat_m)
    return None if told is None else f"{reversal.field}: {told}, as if {reversal.cause}: {reversal.check}; no range is believed"


def misread_shape(range_m: np.ndarray, reversed_m: np.ndarray, amplitude: np.ndarray, sure: np.ndarray, rays: np.ndarray, *,
                  repeat_m: float) -> str | None:
    """Return that surfaces are plane only if the ranges are reversed, in words; None where they are not, or too few tell.

    A bowl of just the radius would pass for a reversed plane. So light must fall with the reversed range, as it does not in a bowl.

    Args:
        range_m, reversed_m: [rows, cols] metres, as declared and reversed.
        amplitude: [rows, cols], in any unit.
        sure: [rows, cols] bool, pixels with a range.
        rays: [rows, cols, 3] unit directions of the lines of sight.
        repeat_m: what a range and the reversed one add up to, but for the wraps of phases.
    """
    lit = sure & (range_m > 0) & (reversed_m > 0) & (amplitude > 0)
    layers = np.concatenate([np.stack([range_m, reversed_m, np.log(np.where(lit, amplitude, 1.0))], axis=-1), rays], axis=-1)
    layers[~lit] = np.nan
    rows, cols = lit.shape
    blocks = [block for top in range(FIRST_BLOCKS) for left in range(FIRST_BLOCKS)
              for block in _blocks(layers, top * rows // FIRST_BLOCKS, left * cols // FIRST_BLOCKS, rows // FIRST_BLOCKS,
                                   cols // FIRST_BLOCKS, FIRST_BLOCKS, repeat_m)]
    area = sum(block.area for block in blocks)
    plane, other = (sum(block.area for block in blocks if np.abs(getattr(block, name)).max() < FLAT)
                    for name in ("bends", "reversed_bends"))
    if area < LEAST_AREA or other < max(PLANES * area, TIMES * plane):
        return None
    falls, far = sum(block.falls for block in blocks), sum(block.far for block in blocks)
    if not STEEPEST * far < falls < FLATTEST * far:
        return None
    return f"{100 * other / area:.0f} % of the surfaces are plane if ranges are reversed, and {100 * plane / area:.0f} % as declared"


def _blocks(layers: np.ndarray, top: int, left: int, rows: int, cols: int, blocks: int, repeat_m: float) -> Iterator[_Block]:
    """Yield the blocks of a part of the image that tell a bend."""
    if min(rows, cols) < CELLS:
        return
    found = _fit(layers[top:top + rows, left:left + cols], repeat_m)
    if found is not None:
        yield found._replace(area=1 / blocks**2)
    elif blocks < MOST_BLOCKS:
        for down in (0, rows // 2):
            for right in (0, cols // 2):
                yield from _blocks(layers, top + down, left + right, rows // 2, cols // 2, 2 * blocks, repeat_m)


def _fit(block: np.ndarray, repeat_m: float) -> _Block | None:
    """Return the bends of the surface in a block, of [rows, cols, 6] layers; None if it has no range, or is not one smooth surface."""
    high, wide = block.shape[0] // CELLS, block.shape[1] // CELLS
    cells = block[:high * CELLS, :wide * CELLS].reshape(CELLS, high, CELLS, wide, -1).mean(axis=(1, 3)).reshape(CELLS * CELLS, -1)
    cells = cells[np.isfinite(cells[:, 0])]
    if len(cells) < LEAST_CELLS:
        return None
    rays = cells[:, 3:] / np.linalg.norm(cells[:, 3:], axis=1, keepdims=True)
    axis = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    along = rays @ axis
    x, y = rays @ side / along, rays @ np.cross(axis, side) / along
    size = max(float(np.abs(x).max()), float(np.abs(y).max()))
    x, y = x / size, y / size
    design = np.stack([np.ones_like(x), x, y, x * x, y * y, x * y], axis=1)
    inverse = np.linalg.pinv(design)
    spread = np.sqrt((inverse[3:5] ** 2).sum(axis=1).max() / (len(cells) - design.shape[1]))
    bends = []
    for range_m in (cells[:, 0], cells[:, 1]):
        value = 1 / (range_m * along)  # linear in x and y on a plane
        fit = inverse @ value
        unit = 2 / (repeat_m * (size * fit[0]) ** 2)
        if np.linalg.norm(value - design @ fit) * spread * unit > SURE_BEND:
            return None
        bends.append(fit[3:5] * unit)
    bright, far = cells[:, 2] - cells[:, 2].mean(), np.log(cells[:, 1]) - np.log(cells[:, 1]).mean()
    return _Block(0.0, bends[0], bends[1], float((bright * far).sum()), float((far * far).sum()))
