"""Height maps of boards as files: board.exr, and the nominal map of a golden board or a design, on which a stitched board is placed.

A board of another size, unit or handedness than its nominal map is refused.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.boards.stitching.form import without_plane
from service.boards.stitching.grid import BoardGrid, HeightMap, HeightPatch
from service.boards.stitching.overlap import Evidence, Overlap, measure_overlap
from service.boards.stitching.stitching import MILLI, SEARCH_SIGMA, SHIFT_SIGMA_PX, TURN_SIGMA_DEGREES, Stitched, TilePoints
from stage.errors import BoardError, ManifestError, ResultError
from stage.formats import exr
from stage.records import read_record
from stage.results.result_metadata import camera_and_provenance, result_file, result_metadata
from stage.sets.board import BoardDesign, BoardRegions, Region

BOARD_FILE = "board.exr"
HEIGHT, SIGMA, NOISE, MASK = "height.Z", "sigma.Z", "noise.Z", "mask.Y"
LEAST_SHARE = 0.5
"""The least part of either map that the other must cover."""
LEAST_MIRRORED = 0.8
"""A board is mirrored if its mirror image correlates so well with the nominal map, and itself not."""


class Nominal(NamedTuple):
    """The nominal heights with which a board is compared."""

    path: Path
    """The file that was named."""
    name: str
    heights: HeightMap
    regions: tuple[Region, ...]


def write_board(path: Path, heights: HeightMap, provenance: dict[str, str]) -> None:
    """Write board.exr: the height, its σ and the part of σ that is noise, all 0 outside of the mask."""
    there = heights.measured
    layers = {HEIGHT: heights.height, SIGMA: heights.sigma, NOISE: np.sqrt(heights.variance)}
    channels = {name: np.where(there, values, 0).astype(np.float32) for name, values in layers.items()}
    exr.write(path, {**channels, MASK: there.astype(np.float16)}, color_space=exr.DATA,
              metadata=result_metadata(heights.grid.camera(), provenance))


def read_golden(path: Path, regions: Path | None = None) -> Nominal:
    """Read the height map of a good board.
    `path`: a result folder of relit inspect-board, or its board.exr. `regions`: the JSON file of the regions that are judged on it; None:
    there are none."""
    file = result_file(path, BOARD_FILE, command="relit inspect-board")
    channels, metadata = exr.read(file)
    camera, _ = camera_and_provenance(metadata, file, file_name=BOARD_FILE)
    try:
        grid = BoardGrid.of(camera)
    except ValueError as error:
        raise ResultError(f"{file}: {error}") from error
    judged: tuple[Region, ...] = ()
    if regions is not None:
        judged = read_record(regions, BoardRegions).regions
        _check_places(regions, judged, grid)
    return Nominal(file, file.parent.name, _heights(file, channels, grid), judged)


def read_design(path: Path) -> Nominal:
    """Read a design: its JSON file and the height map that it names, which has the size that the file says."""
    design = read_record(path, BoardDesign)
    file = path.parent / design.height_map.path
    channels, _ = exr.read(file)
    shape = next(iter(channels.values())).shape
    width, height = design.height_map.resolution
    if shape != (height, width):
        raise ManifestError(f"{path}: height_map: {design.height_map.path} has {shape[1]}x{shape[0]} pixels, resolution says "
                            f"{width}x{height}")
    grid = BoardGrid(design.height_map.pixel_m, *design.height_map.top_left_m, height, width)
    _check_places(path, design.regions, grid)
    return Nominal(path, design.name, _heights(file, channels, grid), design.regions)


def _check_places(path: Path, regions: tuple[Region, ...], grid: BoardGrid) -> None:
    for region in regions:
        (x, y), (across, down) = region.centre_m, region.size_m
        row, col = grid.place(np.array([x - across / 2, x + across / 2]), np.array([y + down / 2, y - down / 2]))
        if min(row.min(), col.min()) < -0.6 or row.max() > grid.rows - 0.4 or col.max() > grid.cols - 0.4:
            raise ManifestError(f"{path}: regions: {region.name} lies beyond the height map, which is "
                                f"{grid.size_m[0]:.4g} m wide and {grid.size_m[1]:.4g} m high: give lengths in metres")


def _heights(file: Path, channels: dict[str, np.ndarray], grid: BoardGrid) -> HeightMap:
    if HEIGHT not in channels:
        raise ResultError(f"{file}: has no layer {HEIGHT}")
    height = channels[HEIGHT].astype(np.float64)
    there = np.isfinite(height)
    if MASK in channels:
        there &= channels[MASK] > 0.5
    if not there.any():
        raise ResultError(f"{file}: its mask leaves no pixel")
    sigma = channels[SIGMA].astype(np.float64) if SIGMA in channels else np.zeros(height.shape)
    noise = channels[NOISE].astype(np.float64) if NOISE in channels else sigma
    shared = np.sqrt(np.maximum(sigma**2 - noise**2, 0))
    return HeightMap(grid, *(np.where(there, values, np.nan) for values in (height, noise**2, shared)))


class Match(NamedTuple):
    """The position of a board on its nominal map."""

    motion: np.ndarray  # [6] of the board, metres
    evidence: Evidence
    correlation: float
    shift_sigma_m: tuple[float, float]
    """Standard deviation of the shift along x and y."""
    warnings: list[str]


def match(measured: HeightMap, stitched: Stitched, nominal: Nominal, *, placement_m: float | None) -> Match:
    """Register a height map to the nominal one; both are on the nominal grid, the measured one at the stage's pose.
    `placement_m`: standard deviation of the board's place, metres; None: SHIFT_SIGMA_PX pixels. Raises BoardError if the board is not the
    nominal one, is mirrored, or its heights have another unit."""
    grid = nominal.heights.grid
    sigma = placement_m or SHIFT_SIGMA_PX * grid.pixel_m
    search = max(1, int(np.ceil(SEARCH_SIGMA * sigma / grid.pixel_m)))
    first, second = _patch(nominal.heights), _patch(measured)

    def compare(other: HeightPatch) -> Overlap | None:
        return measure_overlap(first, other, grid, centre=stitched.centre, length_m=stitched.length_m, shift_sigma_m=sigma,
                               search_px=search)

    found = compare(second)
    if found is None:
        raise BoardError(f"{nominal.path}: the board has too few pixels in common with it")
    _check_unit(measured, nominal)
    if found.evidence is Evidence.DIFFERS:
        turned = compare(second._replace(height=second.height[:, ::-1], variance=second.variance[:, ::-1],
                                         col=second.col - (second.height.shape[1] % 2 == 0)))  # about a middle column
        if turned is not None and turned.correlation >= LEAST_MIRRORED and turned.correlation > found.correlation:
            raise BoardError(f"{nominal.path}: the board is mirrored against it: its mirror image fits (correlation "
                             f"{turned.correlation:.2f}), itself does not ({found.correlation:.2f})")
        raise BoardError(f"{nominal.path}: is not of this board: the correlation of their heights is {found.correlation:.2f} at the best "
                         f"place within {search * grid.pixel_m:.3g} m")
    warnings = []
    if found.evidence is Evidence.FLAT:
        warnings.append("there is too little relief to register the board to its nominal heights: it lies where the stage says")
    if found.evidence is Evidence.REPEATS:
        several = found.candidates
        away = float(np.hypot(*(several[1].difference[:2] - several[0].difference[:2])))
        raise BoardError(f"{nominal.path}: places of the board that differ by {away:.3g} m fit alike, because it repeats itself: give "
                         "--placement-m if its fixture is more exact")
    turn = np.radians(TURN_SIGMA_DEGREES) * stitched.length_m
    prior = np.diag([sigma**-2, sigma**-2, turn**-2, 0, 0, 0])  # what is not measured lies where the stage says
    covariance = np.linalg.inv(found.information + prior)
    motion = -covariance @ found.information @ found.difference
    shift = np.sqrt(np.diag(covariance))
    return Match(motion, found.evidence, found.correlation, (float(shift[0]), float(shift[1])), warnings)


def check_size(measured: HeightMap, tiles: Sequence[TilePoints], stitched: Stitched, nominal: Nominal) -> None:
    """Refuse a nominal map that is not as large as the board, or lies elsewhere than the blend of the tiles on its grid, `measured`."""
    grid, pixel = nominal.heights.grid, stitched.grid.pixel_m
    own = stitched.grid.size_m
    sizes = f"it is {grid.size_m[0]:.4g} x {grid.size_m[1]:.4g} m, the board was measured over {own[0]:.4g} x {own[1]:.4g} m"
    ratio = max(grid.size_m) / max(own)
    if abs(np.log10(ratio)) > 1.5:
        hint = ", as millimetres taken for metres do" if 0.3 < ratio / MILLI < 3 or 0.3 < ratio * MILLI < 3 else ""
        raise BoardError(f"{nominal.path}: is not of this board: {sizes}; the sizes differ {max(ratio, 1 / ratio):.3g}-fold{hint}")
    wanted, there = nominal.heights.measured, measured.measured
    share = float((there & wanted).sum() / wanted.sum())
    covered = _covered(tiles, stitched, nominal)
    if share < LEAST_SHARE:
        if pixel > 1.2 * grid.pixel_m and covered >= LEAST_SHARE:
            raise BoardError(f"{nominal.path}: its pixels of {grid.pixel_m:.3g} m are finer than the points of the tiles, which are "
                             f"{pixel:.3g} m apart")
        raise BoardError(f"{nominal.path}: is not of this board: {100 * share:.0f} % of its pixels were measured; {sizes}")
    if covered < LEAST_SHARE:
        raise BoardError(f"{nominal.path}: is not of this board: it covers {100 * covered:.0f} % of what was measured; {sizes}")


def _covered(tiles: Sequence[TilePoints], stitched: Stitched, nominal: Nominal) -> float:
    """Return the part of the measured points that lie on pixels with a nominal height."""
    grid, on, points = nominal.heights.grid, 0, 0
    for tile, motion in zip(tiles, stitched.motions.values, strict=True):
        x, y, _ = tile.moved(motion, centre=stitched.centre, length_m=stitched.length_m)
        row, col = (np.rint(place).astype(np.int64) for place in grid.place(x, y))
        inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
        on += int(nominal.heights.measured[row[inside], col[inside]].sum())
        points += x.size
    return on / points


def _check_unit(measured: HeightMap, nominal: Nominal) -> None:
    """Refuse heights whose scale differs from that of the nominal ones."""
    spans = []
    both = measured.measured & nominal.heights.measured
    for heights in (measured.height, nominal.heights.height):
        row, col = np.nonzero(both)
        values = without_plane(heights[both], row / heights.shape[0], col / heights.shape[1])
        low, high = np.percentile(values, [1, 99])
        spans.append(float(high - low))
    noise = float(np.sqrt(np.median(measured.variance[both])))
    if min(spans) == 0 or max(spans) < 10 * noise:
        return
    ratio = spans[1] / spans[0]
    if ratio > 30 or ratio < 1 / 30:
        hint = ", as millimetres taken for metres do" if 0.3 < ratio / MILLI < 3 or 0.3 < ratio * MILLI < 3 else ""
        raise BoardError(f"{nominal.path}: is not of this board: its heights span {spans[1]:.3g} m, those measured {spans[0]:.3g} m{hint}")


def _patch(heights: HeightMap) -> HeightPatch:
    row, col = np.nonzero(heights.measured)
    rows, cols = slice(int(row.min()), int(row.max()) + 1), slice(int(col.min()), int(col.max()) + 1)
    floor = np.nanmax(heights.variance) * 1e-6 + 1e-30  # a nominal map may be exact
    return HeightPatch(rows.start, cols.start, heights.height[rows, cols], np.maximum(heights.variance[rows, cols], floor), 1.0)
