"""Scans as the range images that fusion takes: cells of pixels on one surface, what was seen to be empty, and layers to blend."""

from functools import partial
from mmap import MADV_DONTNEED, mmap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from kernels.fusion.resample import STEEPEST, STEP_SIGMAS
from kernels.fusion.views import RangeImage
from service.scans.points.scan import Scan
from service.scans.points.squares import coarser
from stage.capture.camera import Camera
from stage.colour.colour import convert
from stage.results.depth_breaks import connected
from stage.results.depth_normals import depth_normals
from stage.results.maps import SurfaceMaps
from stage.results.mask_border import distance

CLEAR_PIXELS = 2
"""Pixels around a pixel that must all lie behind a point before the point counts as seen to be empty: edges are blurred that far."""
FEATHER_PIXELS = 12.0
"""Distance from the edge of the valid pixels over which the weight of a view in blended colours rises to its full value."""
SQUARE_VOXELS, LEAST_SIDE, LEAST_SQUARES = 0.5, 3, 32
"""Largest side of the squares that pixels are joined in, and least side of the pixels that points become, in voxels; least side of a square
in pixels, of which the bend of the surface can be told; and fewest squares across an image."""
ESTIMATED_SHARE = 0.01
"""Weight of a normal that was fitted to depths beside one of solved maps: where any view has maps, these decide."""
PARALLEL_START_M = 1e-3
"""Depth of the nearest point that an orthographic camera measured, metres: its frame has no place along the lines of sight."""
NORMAL_RADIUS_PX = 2
"""Radius of the neighbourhood that a normal of a range image is fitted to: 25 pixels."""
NORMAL, COLOUR, ALBEDO, SPECULAR, ROUGHNESS = "normal", "colour", "diffuse_albedo", "specular", "roughness"
WIDTHS = {NORMAL: 3, COLOUR: 3, ALBEDO: 3, SPECULAR: 3, ROUGHNESS: 1}
"""Channels of each layer; behind each but the normal follows one that says where a scan has it, 1 or 0."""


class PreparedScan(NamedTuple):
    """A scan as a range image, with its arrays in files that are mapped into memory."""

    name: str
    image: RangeImage
    camera: Camera
    names: tuple[str, ...]  # of the layers
    layers: np.ndarray  # [rows, cols, C] float32, as `channels` orders them
    feather: np.ndarray  # [rows, cols] float32, 0…1
    photometric: bool
    normal_sigma: float = float("nan")
    """Median standard error of the normals of solved maps, radians; NaN: there are none, or their maps do not say it."""
    square_px: int = 1
    """Side, in pixels of the scan, of the squares that are the pixels here."""

    def release(self) -> None:
        """Give the memory of the mapped arrays back; what is asked for again comes from the files. Other threads may read meanwhile."""
        for array in (self.image.depth, self.image.sigma, self.image.normal, self.image.cell, self.image.clear, self.layers, self.feather):
            if isinstance(array, np.memmap) and isinstance(array.base, mmap):
                array.base.madvise(MADV_DONTNEED)


def channels(names: tuple[str, ...]) -> dict[str, slice]:
    """Return where the channels of each layer are, its values without that which says where it is known."""
    places, first = {}, 0
    for name in names:
        places[name] = slice(first, first + WIDTHS[name])
        first += WIDTHS[name] + (name != NORMAL)
    return places


def prepare_scan(scan: Scan, folder: Path, voxel_m: float | None = None) -> PreparedScan:
    """Return a scan as a range image with the layers that it has, its arrays in files of a folder.
    `scan`: a range image with a pose. `voxel_m`: metres, to which pixels that are far smaller are joined in squares, unless the scan has
    maps or an orthographic camera; None: they stay."""
    pose, camera = scan.pose, scan.camera
    assert pose is not None and camera is not None
    parallel = camera.projection == "orthographic"
    side = 1 if voxel_m is None or scan.maps is not None or parallel else _square_side(scan, camera, voxel_m)
    if side > 1:
        scan = coarser(scan, side)
        assert scan.camera is not None
        camera = scan.camera
    depth = scan.image(-scan.points[:, 2]).astype(np.float32)
    mask = scan.image(np.ones(len(scan.points), dtype=bool))
    sigma = scan.image(scan.depth_sigma())
    maps = None if scan.maps is None else SurfaceMaps.read(scan.maps)
    if maps is not None and maps.height is not None and maps.height_sigma is not None:  # depth and normals have been joined
        joined = mask & maps.mask & (maps.height_sigma > 0) & (parallel | (maps.height < 0))
        depth, sigma = np.where(joined, -maps.height, depth), np.where(joined, maps.height_sigma, sigma)
    normal = depth_normals(depth, mask, camera, sigma=sigma, radius=NORMAL_RADIUS_PX)
    usable = mask & (np.abs(normal).sum(axis=-1) > 0)
    cell = surface_cells(depth, usable, camera, sigma)
    camera_from_world = np.linalg.inv(pose)
    if parallel:  # its frame is put before everything that it sees
        shift = PARALLEL_START_M - float((depth - STEP_SIGMAS * sigma)[mask].min())
        depth, camera_from_world = np.where(mask, depth + np.float32(shift), 0).astype(np.float32), camera_from_world.copy()
        camera_from_world[2, 3] -= float(np.float32(shift))
    clear = minimum_filter(np.where(mask, depth - STEP_SIGMAS * sigma, 0), 2 * CLEAR_PIXELS + 1, mode="constant")  # 0 beyond the image
    feather = np.clip(distance(np.pad(~cell, 1, constant_values=True))[1:-1, 1:-1] / FEATHER_PIXELS, 0, 1).astype(np.float32)
    distortion = camera.distortion
    layers = _layers(scan, maps, normal)
    stored = partial(_stored, folder)
    image = RangeImage(stored("depth", depth), stored("sigma", sigma), stored("normal", normal), stored("cell", cell),
                       stored("clear", clear), camera_from_world, focal_of(camera), camera.principal_point,
                       (0.0,) * 5 if distortion is None else (*distortion.k, *distortion.p), orthographic=parallel)
    return PreparedScan(scan.name, image, camera, tuple(layers), stored("layers", np.concatenate(list(layers.values()), axis=-1)),
                        stored("feather", feather), scan.maps is not None,
                        _normal_sigma(maps), side)


def _square_side(scan: Scan, camera: Camera, voxel_m: float) -> int:
    """Return the side, in pixels, of the squares in which the pixels of a perspective camera are joined; 1: they stay."""
    pitch = float(np.median(-scan.points[:, 2])) / min(focal_of(camera))
    side = min(int(SQUARE_VOXELS * voxel_m / pitch), min(camera.resolution) // LEAST_SQUARES)
    return side if side >= LEAST_SIDE else 1


def focal_of(camera: Camera) -> tuple[float, float]:
    """Return the focal lengths in pixels, or the pixels for each metre of an orthographic camera."""
    if camera.focal_px is not None:
        return camera.focal_px
    assert camera.pixel_size_m is not None  # read_scan saw to it
    return 1 / camera.pixel_size_m, 1 / camera.pixel_size_m


def _normal_sigma(maps: SurfaceMaps | None) -> float:
    if maps is None or maps.sigma is None or not maps.mask.any():
        return float("nan")
    return float(np.radians(np.median(maps.sigma[maps.mask].astype(np.float64))))


def with_layers(scan: PreparedScan, names: tuple[str, ...], folder: Path) -> PreparedScan:
    """Return a scan with these layers, of which those that it lacks are 0, in a file of a folder."""
    if scan.names == names:
        return scan
    own = channels(scan.names)
    planes = []
    for name in names:
        count = WIDTHS[name] + (name != NORMAL)
        planes.append(scan.layers[..., own[name].start:own[name].start + count] if name in own
                      else np.zeros((*scan.layers.shape[:2], count), dtype=np.float32))
    return scan._replace(names=names, layers=_stored(folder, "all_layers", np.concatenate(planes, axis=-1)))


def _stored(folder: Path, name: str, values: np.ndarray) -> Any:
    """Return an array in a file that is mapped into memory."""
    path = folder / f"{name}.npy"
    np.save(path, values)
    return np.load(path, mmap_mode="r")


def surface_cells(depth: np.ndarray, mask: np.ndarray, camera: Camera, sigma: np.ndarray) -> np.ndarray:
    """Return [rows, cols] bool, whether a pixel and its neighbours to the right, below and across show one surface."""
    right, down, across, back = (connected(np.where(mask, depth, 1), mask, camera, offset, sigma=sigma)
                                 for offset in ((0, 1), (1, 0), (1, 1), (1, -1)))
    cell = np.zeros(depth.shape, dtype=bool)
    corners = np.stack([depth[:-1, :-1], depth[:-1, 1:], depth[1:, :-1], depth[1:, 1:]])
    noise = np.maximum.reduce([sigma[:-1, :-1], sigma[:-1, 1:], sigma[1:, :-1], sigma[1:, 1:]])
    nearest = corners.min(axis=0) if camera.projection == "perspective" else 1.0
    gentle = np.ptp(corners, axis=0) <= STEEPEST * nearest / min(focal_of(camera)) + STEP_SIGMAS * noise
    cell[:-1, :-1] = right[:-1, :-1] & right[1:, :-1] & down[:-1, :-1] & down[:-1, 1:] & across[:-1, :-1] & back[:-1, 1:] & gentle
    return cell


def _layers(scan: Scan, maps: SurfaceMaps | None, normal: np.ndarray) -> dict[str, np.ndarray]:
    """Return the layers of a scan by name, in the order of WIDTHS, each but the normal followed by where it is known."""
    shape = normal.shape[:2]
    known: np.ndarray = np.zeros(shape, dtype=bool) if maps is None or maps.normal is None else maps.mask & maps.normal.any(axis=-1)
    solved = normal if maps is None or maps.normal is None else maps.normal
    found = {NORMAL: np.where(known[..., None], solved, np.float32(ESTIMATED_SHARE) * normal).astype(np.float32)}
    if scan.colours is not None:
        colours = convert(scan.image(scan.colours).astype(np.float32) / 255, "srgb_rec709_scene", "lin_rec709_scene")
        found[COLOUR] = _masked(colours, scan.image(np.ones(len(scan.points), dtype=bool)))
    for name in (ALBEDO, SPECULAR, ROUGHNESS):
        if maps is not None and (layer := getattr(maps, name)) is not None:
            values = layer.reshape(*shape, -1).astype(np.float32)
            if WIDTHS[name] == 3 and maps.color_space != "lin_rec709_scene":
                values = convert(values, maps.color_space, "lin_rec709_scene")
            found[name] = _masked(values, maps.mask)
    return found


def _masked(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return values that are 0 where they are not known, followed by where they are, [rows, cols, C + 1] float32."""
    return np.concatenate([np.where(known[..., None], values, 0), known[..., None]], axis=-1).astype(np.float32)
