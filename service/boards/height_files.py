"""Height maps of boards as files: board.exr, and the nominal map of a golden board or a design."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.boards.stitching.grid import BoardGrid, HeightMap
from stage.errors import ManifestError, ResultError
from stage.formats import exr
from stage.records import read_record
from stage.results.result_metadata import camera_and_provenance, result_metadata
from stage.sets.board import DESIGN_SCHEMA, REGIONS_SCHEMA, BoardDesign, BoardRegions, Region

BOARD_FILE = "board.exr"
HEIGHT, SIGMA, NOISE, MASK = "height.Z", "sigma.Z", "noise.Z", "mask.Y"


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

    Args:
        path: a result folder of relit inspect-board, or its board.exr.
        regions: the JSON file of the regions that are judged on it; None: there are none.
    """
    file = path / BOARD_FILE if path.is_dir() else path
    channels, metadata = exr.read(file)
    camera, _ = camera_and_provenance(metadata, file, file_name=BOARD_FILE)
    try:
        grid = BoardGrid.of(camera)
    except ValueError as error:
        raise ResultError(f"{file}: {error}") from error
    judged: tuple[Region, ...] = ()
    if regions is not None:
        judged = read_record(regions, BoardRegions, REGIONS_SCHEMA).regions
        _check_places(regions, judged, grid)
    return Nominal(file, file.parent.name, _heights(file, channels, grid), judged)


def read_design(path: Path) -> Nominal:
    """Read a design: its JSON file and the height map that it names, which has the size that the file says."""
    design = read_record(path, BoardDesign, DESIGN_SCHEMA)
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
    """Check that regions lie on the height map."""
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
