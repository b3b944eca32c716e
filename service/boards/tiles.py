"""Read the tiles of a board: depth results as they are, captures decoded by the depth product."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import grey_dilation, label, maximum, minimum, rank_filter

from service.boards.stitching.stitching import TilePoints
from service.depth.depth import depth
from service.reporting.progress import Progress
from service.requests.depth import DepthRequest
from stage.capture.manifest import FILE_NAME
from stage.errors import BoardError, ManifestError
from stage.files import temporary_folder
from stage.records import read_record
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from stage.sets.board import SCAN_FILE, BoardScan, Tile

MOST_OF_TILE, MOST_OF_PIXEL = 1 / 3, 10.0
"""Errors of the stage and of the fixture whose threefold, which is searched, is larger than a tile or a board, and pixels so many times
larger or smaller than the distance of points, have another unit."""
SPIKE = 6.0
"""σ beyond its neighbours from which on a point is an outlier."""
RING = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=bool)
GROUP_FORMS = (1, 4, 20, 110, 638)
"""The number of forms that a group of 1, 2, … pixels has which touch by sides or corners (fixed polykings)."""
CHANCE = 0.001
"""The expected number of groups of a size in a tile from which on that size comes together by chance."""


class BoardTiles(NamedTuple):
    """The tiles of a board."""

    path: Path
    """The board.json."""
    scan: BoardScan
    tiles: list[TilePoints]
    contents: dict[str, str]
    """The content hash that the depth of each tile carries, by the path of the tile."""


def read_tiles(path: Path, *, device: str | None, cache: Path | None, progress: Progress) -> BoardTiles:
    """Read a board.json, or that in a folder, and all of its tiles; captures are decoded on the device, with their image stacks in the
    folder `cache`, or beside each where it is None."""
    file = path / SCAN_FILE if path.is_dir() else path
    scan = read_record(file, BoardScan)
    progress.stage("tiles", len(scan.tiles))
    tiles, contents = [], {}
    for number, tile in enumerate(scan.tiles):
        maps = _maps(file, tile, device, cache)
        tiles.append(_points(file, tile, maps, number))
        contents[tile.path] = maps.provenance.get("relit:inputs", "")
        progress.advance(number + 1)
    return BoardTiles(file, scan, tiles, contents)


def check_lengths(board: BoardTiles, *, pixel_m: float | None, placement_m: float | None) -> None:
    """Check that lengths that are given fit the tiles; those in another unit would search far beyond the board, or need all memory.
    `pixel_m`, `placement_m`: as of a request. Raises BoardError; it names the field."""
    widths = [max(np.ptp(tile.x), np.ptp(tile.y)) for tile in board.tiles]
    tile, apart = float(min(widths)), max(each.pixel_m for each in board.tiles)
    whole = max(widths) + float(np.ptp([each.middle for each in board.tiles], axis=0).max())
    for what, given, least, most, beside in (
            (f"{board.path}: stage_sigma_m", board.scan.stage_sigma_m, 0.0, MOST_OF_TILE * tile, f"tiles are {tile:.3g} m wide"),
            ("--placement-m", placement_m, 0.0, MOST_OF_TILE * whole, f"the board is {whole:.3g} m wide"),
            ("--pixel-m", pixel_m, apart / MOST_OF_PIXEL, MOST_OF_PIXEL * apart, f"points of the tiles are {apart:.3g} m apart")):
        if given is not None and not least <= given <= most:
            raise BoardError(f"{what}: is {given:g} m, and {beside}: give metres, from {least:.3g} to {most:.3g}")


def _maps(file: Path, tile: Tile, device: str | None, cache: Path | None) -> DepthMaps:
    folder = file.parent / tile.path
    if (folder / DEPTH_FILE).is_file():
        return DepthMaps.read(folder / DEPTH_FILE)
    if not (folder / FILE_NAME).is_file():
        raise ManifestError(f"{file}: tiles: {tile.path} holds neither {DEPTH_FILE} nor {FILE_NAME}: give folders of depth results or "
                            "captures")
    with temporary_folder("tile") as out:
        maps = depth(DepthRequest(capture=folder, out=out, device=device, cache=None if cache is None else cache / tile.path)).maps
    if not isinstance(maps, DepthMaps):
        raise ManifestError(f"{folder / FILE_NAME}: projector is missing: its pixels have projector coordinates and no depth in metres")
    return maps


def _points(file: Path, tile: Tile, maps: DepthMaps, number: int) -> TilePoints:
    """Return the points of a tile in the board frame, at the pose that the stage or the manifest gives."""
    where = f"{file}: tiles[{number}] ({tile.path})"
    if maps.sigma is None:
        raise ManifestError(f"{where}: its depth has no layer sigma.Z: an inspection decides by the uncertainty of every depth")
    if not maps.camera.metric and maps.camera.projection == "orthographic":
        raise ManifestError(f"{where}: camera.pixel_size_m is missing: tiles are placed in metres")
    used = maps.mask & (maps.sigma > 0)
    if not used.any():
        raise BoardError(f"{where}: no pixel has a depth with a σ")
    pose = _pose(where, tile, maps)
    points = maps.camera.points(-maps.depth)[used].astype(np.float64) @ pose[:3, :3].T
    along = float(abs(pose[2, 2]))  # σ is that of the depth, whose axis the camera looks along
    if along < 0.5:
        raise ManifestError(f"{where}: its camera looks along the board, not at it: check its pose")
    middle = np.median(points, axis=0)
    local = (points - middle).astype(np.float32)
    height, sigma = without_spikes(local[:, 2], maps.sigma[used] * along, used)
    return TilePoints(tile.path, local[:, 0], local[:, 1], height, sigma.astype(np.float32),
                      middle + pose[:3, 3], _distance(points, used, where), used)


def without_hidden_outliers(tile: TilePoints, deviation: np.ndarray) -> TilePoints:
    """Return a tile with the outliers moved that steps of the board hide among its heights, and that stand out of its deviations from the
    nominal heights, [n] metres, NaN where these are not known."""
    known = np.isfinite(deviation)
    pixels = tile.used.copy()
    pixels[tile.used] = known
    moved = int((tile.sigma > SPIKE * np.median(tile.sigma)).sum())
    told, sigma = without_spikes(deviation[known].astype(np.float32), tile.sigma[known], pixels, known=moved)
    z, wider = tile.z.copy(), tile.sigma.copy()
    z[known] += told - deviation[known].astype(np.float32)
    wider[known] = sigma
    return tile._replace(z=z, sigma=wider)


def without_spikes(height: np.ndarray, sigma: np.ndarray, used: np.ndarray, *, known: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return heights and σ, both [n], of the used pixels of a tile, [rows, cols], with outliers moved to their neighbours.

    An outlier lies beyond all of its eight neighbours but one by more than SPIKE σ. It is moved to the second of them, so that the slopes
    around it are not its own, and its σ grows by as much as it was moved. A group of outliers lies as far beyond all around it, and has
    no more pixels than groups have that come together by chance where so many are outliers; it is moved to the nearest of those around.
    `known`: outliers that were found before.
    """
    image = np.full(used.shape, np.nan, dtype=np.float32)
    image[used] = height
    limit = np.zeros(used.shape, dtype=np.float32)
    limit[used] = SPIKE * sigma
    told = image.copy()
    single = np.zeros(used.shape, dtype=bool)
    groups = []
    for sign in (1, -1):
        up = np.where(used, sign * image, -np.inf).astype(np.float32)
        second, fifth = (rank_filter(up, -1 - others, footprint=RING, mode="constant", cval=-np.inf) for others in (1, 4))
        spike = used & np.isfinite(second) & (up > second + limit)
        single |= spike
        told[spike] = sign * second[spike]
        marked = used & np.isfinite(fifth) & (up > fifth + limit)
        labels, count = label(marked, structure=np.ones((3, 3)))
        numbers = np.arange(1, count + 1)
        around = grey_dilation(np.where(marked, -np.inf, up), footprint=RING, mode="constant", cval=-np.inf)
        border = np.concatenate([[np.inf], np.atleast_1d(maximum(around, labels, numbers))]) if count else np.array([np.inf])
        base = np.concatenate([[-np.inf], np.atleast_1d(minimum(up - limit, labels, numbers))]) if count else np.array([-np.inf])
        groups.append((sign, labels, np.where(base > border, border, np.inf)))
    most = _together(int(single.sum()) + known, int(used.sum()))
    for sign, labels, border in groups:
        small = (labels > 0) & np.isfinite(border[labels]) & (np.bincount(labels.ravel())[labels] <= most)
        told[small] = sign * border[labels[small]]
    return told[used], np.hypot(sigma, told[used] - height)


def _together(outliers: int, pixels: int) -> int:
    """Return how many outliers come together by chance, where so many of the pixels are outliers and do not know of each other."""
    share = outliers / max(pixels, 1)
    return max(size for size, forms in enumerate(GROUP_FORMS, start=1) if size == 1 or pixels * forms * share**size > CHANCE)


def _pose(where: str, tile: Tile, maps: DepthMaps) -> np.ndarray:
    """Return world_from_camera of a tile, [4, 4]."""
    if tile.position_m is not None:
        pose = np.eye(4)
        pose[: len(tile.position_m), 3] = tile.position_m
        return pose
    if maps.camera.world_from_camera is None:
        raise ManifestError(f"{where}: position_m is missing, and so is world_from_camera of its camera: give where the stage held it")
    return np.array(maps.camera.world_from_camera, dtype=np.float64)


def _distance(points: np.ndarray, used: np.ndarray, where: str) -> float:
    """Return the median distance in the plane of the board between points of neighbouring pixels, the larger of both directions."""
    place = np.full((*used.shape, 2), np.nan)
    place[used] = points[:, :2]
    apart = [np.linalg.norm(np.diff(place, axis=axis), axis=-1) for axis in (0, 1)]
    known = [values[np.isfinite(values)] for values in apart]
    if min(values.size for values in known) == 0:
        raise BoardError(f"{where}: no two neighbouring pixels have a depth")
    return float(f"{max(float(np.median(values)) for values in known):.6g}")  # positions are float32, which says no more
