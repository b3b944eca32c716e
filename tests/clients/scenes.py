"""Light and objects with known pictures for tests that open assets in other programs."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_erosion

from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps

PATCHES = (((0.7, 0.2, 0.7), (4, 1, 0)), ((-0.3, 0.8, 0.5), (0, 2, 4)), ((0.2, -0.8, 0.3), (1, 4, 1)), ((-1, 0, 0), (3, 0, 3)))
"""Direction and peak radiance."""
DIELECTRIC_F0 = 0.04


def directions(height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions [H, 2 H, 3] and solid angles [H, 2 H] of a lat-long map, from the formula of docs/relight.md."""
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(2 * height) + 0.5) / (2 * height), indexing="ij")
    d = np.stack([np.sin(2 * np.pi * u) * np.sin(np.pi * v), np.cos(np.pi * v), -np.cos(2 * np.pi * u) * np.sin(np.pi * v)], axis=-1)
    return d, np.sin(np.pi * v) * (np.pi / height) ** 2


def uneven(height: int = 64) -> np.ndarray:
    """Return an environment that is another one when it is turned or mirrored."""
    d, _ = directions(height)
    picture = np.full((*d.shape[:2], 3), 0.2)
    for axis, colour in PATCHES:
        apart = np.degrees(np.arccos(np.clip(d @ (np.array(axis) / np.linalg.norm(axis)), -1, 1)))
        picture += np.exp(-0.5 * (apart / 20) ** 2)[..., None] * np.array(colour)
    return picture


class Ball(NamedTuple):
    """A ball of one material, in metres in the camera frame."""

    centre: tuple[float, float, float]
    radius: float
    base_color: tuple[float, float, float]
    metallic: float
    roughness: float


PAINT = Ball((-0.012, -0.012, 0.0), 0.082, (0.55, 0.2, 0.12), 0.0, 0.45)
GOLD = Ball((0.03, 0.032, 0.11), 0.032, (0.95, 0.70, 0.30), 1.0, 0.36)


def ball_maps(camera: Camera, balls: tuple[Ball, ...]) -> tuple[SurfaceMaps, np.ndarray]:
    """Return the true maps of balls, one part each, and the metallic [rows, cols], as an orthographic camera sees them."""
    assert camera.pixel_size_m is not None
    width, height = camera.resolution
    rows, cols = np.mgrid[:height, :width] + 0.5
    x, y = (cols - width / 2) * camera.pixel_size_m, (height / 2 - rows) * camera.pixel_size_m
    z, part = np.full(x.shape, -np.inf), np.zeros(x.shape, np.uint8)
    normal, values = np.zeros((*x.shape, 3)), np.zeros((*x.shape, 5))
    for number, each in enumerate(balls, start=1):
        offset = np.stack([x - each.centre[0], y - each.centre[1]], axis=-1) / each.radius
        under = 1 - (offset**2).sum(axis=-1)
        seen = (under > 0) & (each.centre[2] + each.radius * np.sqrt(np.maximum(under, 0)) > z)
        z[seen] = each.centre[2] + each.radius * np.sqrt(under[seen])
        normal[seen] = np.concatenate([offset, np.sqrt(np.maximum(under, 0))[..., None]], axis=-1)[seen]
        values[seen] = [*each.base_color, each.metallic, each.roughness]
        part[seen] = number
    mask = binary_erosion(part > 0)
    base, metallic, roughness = values[..., :3], values[..., 3], values[..., 4]
    share = metallic[..., None]
    return SurfaceMaps(camera=camera, mask=mask, normal=normal.astype(np.float32), diffuse_albedo=((1 - share) * base).astype(np.float32),
                       specular=((1 - share) * DIELECTRIC_F0 + share * base).astype(np.float32), roughness=roughness.astype(np.float32),
                       height=np.where(mask, z, 0).astype(np.float32), part=np.where(mask, part, 0)), metallic


def ball_arrays(balls: tuple[Ball, ...], rings: int = 96) -> dict[str, np.ndarray]:
    """Return whole balls as benchmarks.clients.render.trace takes them."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1), indexing="ij")
    normal = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], axis=-1).reshape(-1, 3)
    number = np.arange(normal.shape[0]).reshape(polar.shape)
    a, b, c, d = (each.ravel() for each in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]).astype(np.uint32)
    arrays: dict[str, np.ndarray] = {}
    for index, each in enumerate(balls):
        found = {"points": normal * each.radius + each.centre, "normals": normal, "st": np.zeros((len(normal), 2)),
                 "diffuseColor": np.array(each.base_color), "metallic": np.array(each.metallic), "roughness": np.array(each.roughness),
                 "normal": np.array([0, 0, 1]), "opacity": np.array(1), "ior": np.array(1.5)}
        arrays |= {f"{index}.{name}": value.astype(np.float32) for name, value in found.items()} | {f"{index}.triangles": triangles}
    return arrays


def seen_in_perspective(maps: SurfaceMaps) -> SurfaceMaps:
    """Return the maps as if a turned perspective camera of known scale had seen them, one metre away."""
    width, height = maps.camera.resolution
    camera = Camera(projection="perspective", resolution=(width, height), focal_px=(4.8 * width,) * 2,
                    principal_px=(width / 2, height / 2 - 1), surface_z_m=-1.0,
                    world_from_camera=((0, 0, 1, 0.5), (1, 0, 0, -2), (0, 1, 0, 0.25), (0, 0, 0, 1)))
    return replace(maps, camera=camera, height=np.where(maps.mask, maps.height - 1, 0))


def without_scale(maps: SurfaceMaps) -> SurfaceMaps:
    """Return the maps as a capture without a scale gives them: heights in pixels."""
    camera = Camera(projection="orthographic", resolution=maps.camera.resolution)
    return replace(maps, camera=camera, height=maps.height / maps.camera.pixel_size_m)
