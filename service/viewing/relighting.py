"""Make the few coefficient images with which a browser relights an object; their coefficients differ from tile to tile.

The images of a small tile have few independent parts, so a few dozen images and a small matrix for each tile show the object as all
captured images together do (kernels.relight.basis.basis has the method and its sources).
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import packs
from kernels.errors import ArrayError
from kernels.relight.basis.basis import gram, light_factor, tile_bases
from kernels.relight.directions.latlong import first_of_equals
from kernels.relight.model.beyond import reach, share_beyond
from service.relight.weights.quadrature import quadrature_of
from service.relight.weights.triangulation import share_smooth
from service.reporting.progress import Timings
from service.viewing.block_file import BlockFile, Place
from service.viewing.card import RelitCard
from service.viewing.light_transfer import COLS, FULL, ROWS, HeldOutLights, grid_directions, transfer_of
from service.viewing.reduction import Tiling, plane_means, put_together, step_within, tile_rows, tiling_of
from stage.capture.point_lights import DistantLights
from stage.results.light_basis import numbers
from stage.results.matte import Matte
from stage.stack.stack import Stack
from stage.stack.stack_file import TOP_EXPONENT

LEAST_LIGHTS = 4
"""The least number of lights for relighting: fewer do not surround any direction."""
DEFAULT_TERMS = 32
"""Most coefficient images, unless the request says otherwise."""
RELATIVE_RMS = 0.005
"""Error of pictures, relative to each, that needs no further coefficient image: half a step of an 8-bit display."""
MOST_VALUES = 64_000_000
"""Most values of all coefficient images in a channel, 32 images of 2 megapixels; larger images are reduced. A page keeps them as textures,
in 512 MB."""
HALF_BOUND = 2.0**15
"""Bound of the stored coefficients, which leaves room below the largest half value."""


class TiledBasis(NamedTuple):
    """A basis in half values, as it is stored: captured image l ≈ scale · Σₖ matrix[l, tile, k] · images[k]."""

    matrix: np.ndarray  # [lights, tiles, terms, 3] float16
    images: np.ndarray  # [terms, 3, rows, cols] float16
    scale: float


def write_relighting(stack: Stack, lights: DistantLights, matte: Matte, file: BlockFile, *, most_terms: int | None,
                     device: str, timings: Timings, folder: Path, space: str) -> dict[str, Any]:
    """Write basis, matte, weights and coefficients of the captured images, and return what view.json says of them.

    Args:
        lights: of the images, near ones as the object's centre sees them.
        matte: of the object; the coefficient images are premultiplied by its coverage.
        most_terms: most coefficient images; None: DEFAULT_TERMS.
        folder: gets the pictures of the card (service.viewing.card).
        space: colour space of the captured images.
    """
    covered = np.zeros(stack.shape[2], dtype=bool)
    covered[: stack.pixel_count] = (matte.factor > 0).reshape(-1)
    most = min(most_terms or DEFAULT_TERMS, stack.light_count)
    timings.stage("directions", 1)
    transfer = transfer_of(lights)
    products = _products(stack, covered, device, timings)
    norm = light_factor(products, transfer.weights.astype(np.float64), transfer.solid_angle)
    step = step_within(matte.factor.size, MOST_VALUES // most)
    tiling = tiling_of(plane_means(matte.factor, step), lights=stack.light_count, terms=most)
    basis = _basis(stack, matte, tiling, step, norm, products, most, timings)
    held_out = HeldOutLights(stack, lights, transfer, covered)
    card = RelitCard(lights, *basis.images.shape[2:])
    relative_rms = _error(stack, matte, tiling, step, basis, held_out, card, timings)
    coverage = plane_means(matte.coverage, step)
    card.write(folder, coverage, space)
    timings.stage("blocks", len(basis.images))
    blocks: list[Place] = []
    for place in file.append_all(iter(basis.images)):
        blocks.append(place)
        timings.advance(len(blocks))
    return {
        "terms": len(basis.images), "rows": coverage.shape[0], "cols": coverage.shape[1], "step": step, "scale": numbers(basis.scale),
        "basis": blocks,
        "tiles": {"side": tiling.side, "rows": tiling.index.shape[0], "cols": tiling.index.shape[1], "count": tiling.tile_count,
                  "index": file.append(tiling.index)},
        "captured": file.append(basis.matrix),
        "matte": file.append(np.rint(FULL * np.clip(coverage, 0, 1)).astype(np.uint8)),
        "directions": [COLS, ROWS],
        "weights": file.append(np.swapaxes(transfer.weights, 1, 2).astype(np.float32)),
        "beyond": file.append(transfer.beyond),
        "quadrature": write_quadrature(lights, file),
        "relative_rms": numbers(relative_rms),
        "held_out": held_out.facts(),
        "beyond_degrees": numbers(float(np.degrees(2 * reach(lights.direction)))),
    }


def _products(stack: Stack, covered: np.ndarray, device: str, timings: Timings) -> np.ndarray:
    """Return [3, lights, lights] the inner products of the captured images over the object, in radiance."""
    count = stack.light_count
    products, scale = np.zeros((3, count, count)), stack.scale[:count].astype(np.float64)
    ranges = list(stack.bands())
    timings.stage("products", len(ranges))
    for done, (start, stop) in enumerate(ranges, start=1):
        if covered[start:stop].any():
            products += gram(packs.upload(stack.band(start, stop), device=device), covered[start:stop])[:, :count, :count]
        timings.advance(done)
    return np.asarray(products * scale[:, None] * scale)


def _basis(stack: Stack, matte: Matte, tiling: Tiling, step: int, norm: np.ndarray, products: np.ndarray, most: int,
           timings: Timings) -> TiledBasis:
    """Return the basis with as few images as the error allows."""
    count = stack.light_count
    rows, cols = (-(-side // step) for side in matte.factor.shape)
    mean = float(np.sqrt(np.einsum("cll->", products) / count)) or 1.0  # brings the matrices to numbers about 1
    largest = float(np.linalg.norm(norm, ord=2, axis=(1, 2)).max() * mean * np.linalg.norm(2.0**TOP_EXPONENT * stack.scale[:count]))
    scale = 2.0 ** math.ceil(math.log2(largest / HALF_BOUND))
    images = np.zeros((most, 3, rows, cols), dtype=np.float16)
    matrix = np.zeros((count, tiling.tile_count, most, 3), dtype=np.float16)
    squares = np.zeros(count)
    for row in tile_rows(stack, matte.factor, tiling, step, timings, "basis"):
        found = tile_bases(row.images, norm, most)
        squares += found.squares.sum(axis=(0, 1))
        matrix[:, row.tiles] = found.matrix.transpose(2, 0, 3, 1) / mean
        stored = (found.coefficients * np.float32(mean / scale)).astype(np.float16)
        planes = put_together(stored.swapaxes(1, 2).reshape(len(stored), 3 * most, -1), row, tiling.side, cols)
        images[:, :, row.rows] = planes.reshape(most, 3, *planes.shape[1:])
    left = np.append(np.cumsum(squares[::-1])[::-1][1:], 0)  # after 1, 2 … images
    terms = min(int((left <= RELATIVE_RMS**2 * squares.sum()).argmax()) + 1, most)
    return TiledBasis(np.ascontiguousarray(matrix[:, :, :terms]), images[:terms], scale)


def _error(stack: Stack, matte: Matte, tiling: Tiling, step: int, basis: TiledBasis, held_out: HeldOutLights, card: RelitCard,
           timings: Timings) -> float:
    """Return the root mean square of what the basis as it is stored leaves of the captured images, relative to them; let held-out lights
    count it, and the card take its pictures."""
    left, whole, side = 0.0, 0.0, tiling.side
    factor = plane_means(matte.factor, step)
    across = -(-factor.shape[1] // side) * side
    for row in tile_rows(stack, matte.factor, tiling, step, timings, "compare"):
        stored = np.zeros((*basis.images.shape[:2], side, across), dtype=np.float32)
        stored[:, :, : row.rows.stop - row.rows.start, : factor.shape[1]] = basis.images[:, :, row.rows]
        inside = np.zeros((side, across), dtype=bool)
        inside[: row.rows.stop - row.rows.start, : factor.shape[1]] = factor[row.rows] > 0
        tiles = stored.reshape(*stored.shape[:2], side, -1, side).transpose(3, 1, 0, 2, 4)[row.columns]  # [tiles, 3, terms, side, side]
        matrix = basis.matrix[:, row.tiles].astype(np.float32).transpose(1, 3, 0, 2)
        images = tiles.reshape(*tiles.shape[:3], -1)
        card.add(row, images, matrix * np.float32(basis.scale), side)
        shown = np.matmul(matrix, images) * np.float32(basis.scale)
        left += float(((row.images - shown) ** 2).sum(dtype=np.float64))
        whole += float((row.images**2).sum(dtype=np.float64))
        held_out.compare(row.images, shown, inside.reshape(side, -1, side).swapaxes(0, 1)[row.columns].reshape(len(row.columns), -1))
    return float(np.sqrt(left / whole)) if whole > 0 else 0.0


def write_quadrature(lights: DistantLights, file: BlockFile) -> dict[str, Any]:
    """Write what a page needs to share light out as `relit relight --weights kernel` does, and return what view.json says of it.

    Light from between the captured lights is shared by kernel quadrature: its moments are sums over directions, and a small system with
    them gives the energies of the lights, none below 0 (service.relight.weights.quadrature). Light from beyond them is shared by a table
    over the grid of directions, since its parts add up (service.relight.weights.triangulation).
    """
    kept = first_of_equals(lights.direction)
    towards = np.ascontiguousarray(lights.direction[kept], dtype=np.float64)
    solved = quadrature_of(towards)
    directions = grid_directions(1)[:, 0]
    beyond = share_beyond(towards, directions)
    outside = np.zeros((len(directions), len(kept)))
    try:
        outside[:] = share_smooth(directions, np.diag(beyond), towards).T
    except ArrayError:  # too few lights for triangles: the kernel shares that light too
        beyond = np.zeros(len(directions))
    return {"range": numbers(solved.range), "kept": [int(index) for index in kept],
            "inverse": file.append(np.asarray(solved.inverse, dtype=np.float64)),
            "beyond": file.append(beyond.astype(np.float32)), "outside": file.append(outside.astype(np.float32))}
