"""A glossy dome under lights all around it, rendered with the float64 twin of the contract's model, and its true maps: what model-guided
relighting and shading are judged on. The dome is convex, so that nothing throws a shadow but attached ones."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.capture.camera import Camera
from stage.results.maps import MAPS_FILE, SurfaceMaps
from stage.transforms import fibonacci_sphere
from tests.reference import microfacet
from tests.scenes import captures

VIEW = np.array([0.0, 0.0, 1.0])
PIXEL_M = 0.001
ALBEDO = np.array([0.5, 0.35, 0.2])
ROUGHNESS, F0 = 0.55, 0.05


class Dome(NamedTuple):
    """The surface."""

    normal: np.ndarray  # [rows, cols, 3]
    height: np.ndarray  # [rows, cols] metres, mean 0 over the mask
    mask: np.ndarray  # [rows, cols] bool

    @property
    def places(self) -> np.ndarray:
        """[rows, cols, 3] metres, camera frame."""
        size = len(self.mask)
        across = (np.arange(size) + 0.5 - size / 2) * PIXEL_M
        x, y = np.meshgrid(across, -across)
        return np.stack([x, y, self.height], axis=-1)

    def off(self, ours: np.ndarray, truth: np.ndarray) -> float:
        """RMS of the difference of two images over the surface, relative to that of the second."""
        return np.sqrt(((ours - truth)[self.mask] ** 2).mean() / (truth[self.mask] ** 2).mean())


def dome(size: int = 24) -> Dome:
    """A spherical cap of 50 degrees."""
    radius = size / 2 / np.sin(np.radians(50.0))
    across = np.arange(size) + 0.5 - size / 2
    x, y = np.meshgrid(across, -across)
    mask = x**2 + y**2 < (size / 2 - 1) ** 2
    z = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 1e-9))
    normal = np.where(mask[..., None], np.stack([x, y, z], axis=-1) / radius, VIEW)
    height = np.where(mask, z - z[mask].mean(), 0) * PIXEL_M
    return Dome(normal / np.linalg.norm(normal, axis=-1, keepdims=True), height, mask)


def reflect(normal: np.ndarray, toward: np.ndarray, roughness: float = ROUGHNESS) -> np.ndarray:
    """[…, 3] radiance under unit irradiance from unit directions; broadcasts."""
    shine = microfacet.specular(normal, toward, VIEW, roughness**2, F0)
    return ALBEDO * microfacet.diffuse(normal, toward, VIEW)[..., None] + shine[..., None]


def sphere_directions(count: int) -> np.ndarray:
    """[count, 3] unit directions, evenly over the sphere."""
    return fibonacci_sphere(count)[:, [1, 2, 0]]


def write_dome(folder: Path, surface: Dome, *, lights: int = 48, irradiance: float = 2.0, directions: np.ndarray | None = None,
               noise: float = 0.0) -> np.ndarray:
    """Write the capture, with noise of this part of the brightest reading; returns the directions of its lights, by default evenly over the
    sphere."""
    directions = sphere_directions(lights) if directions is None else directions
    random = np.random.default_rng(0)

    def seen(direction: np.ndarray) -> np.ndarray:
        image = reflect(surface.normal, direction) * irradiance * surface.mask[..., None]
        return np.maximum(image + noise * image.max() * random.normal(size=image.shape), 0) if noise else image

    write_lit(folder, surface.mask, directions, seen, irradiance=irradiance)
    return directions


def write_lit(folder: Path, mask: np.ndarray, directions: np.ndarray, seen: Callable[[np.ndarray], np.ndarray], *,
              irradiance: float) -> None:
    """Write a capture of distant lights: `seen` is the image [rows, cols, 3] under each of their directions."""
    captures.write_lit(folder, map(seen, directions), [captures.distant(direction, irradiance) for direction in directions], mask=mask,
                       name="dome", color_space="lin_rec709_scene",
                       camera={"projection": "orthographic", "resolution": list(mask.shape[::-1]), "pixel_size_m": PIXEL_M})


def write_maps(folder: Path, surface: Dome, camera: Camera | None = None, **changes: np.ndarray | str | dict[str, str] | None) -> Path:
    """Write the true maps, or changed ones, or those of another camera than the orthographic one of the capture."""
    folder.mkdir(parents=True)
    size = len(surface.mask)
    full = np.ones((size, size, 3), np.float32)
    camera = camera or Camera(projection="orthographic", resolution=(size, size), pixel_size_m=PIXEL_M)
    layers = {"normal": surface.normal.astype(np.float32), "diffuse_albedo": ALBEDO * full, "specular": F0 * full,
              "roughness": ROUGHNESS * full[..., 0], "height": surface.height.astype(np.float32), "confidence": full[..., 0], **changes}
    SurfaceMaps(camera=camera, mask=surface.mask, **layers).write(folder / MAPS_FILE)
    return folder


def lat_long(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """[rows, 2 rows, 3] directions and [rows, 1] solid angles of texels, as of the contract."""
    v, u = (np.arange(rows) + 0.5) / rows * np.pi, (np.arange(2 * rows) + 0.5) / (2 * rows) * 2 * np.pi
    sine = np.sin(v)[:, None]
    directions = np.stack([np.sin(u) * sine, np.cos(v)[:, None] * np.ones(2 * rows), -np.cos(u) * sine], axis=-1)
    return directions, sine * np.pi / rows * np.pi / rows
