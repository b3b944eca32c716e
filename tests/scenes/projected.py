"""Captures under projected patterns, made by a ray caster: spheres and planes, mirrors, fog, textures, blur, gamma and noise.

Each camera pixel is sampled at several places, so that pixels at edges mix what they see. A sample is light of one projector place: its
weight and its (u, v). An image is the sum over these of what the projector shows there, and every pattern costs only that sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import convolve1d, shift

from stage.capture.manifest import Frame
from stage.patterns.codes import Pattern, draw
from stage.patterns.kary import KaryPattern
from tests.reference.projector import look_at
from tests.scenes.captures import write_image, write_manifest

FULL_SCALE = 65535
FINE = 4
"""Parts of a projector pixel, along each side, between which its light changes."""
FAR_M = 1.0e3
"""Distance of what a line of sight that meets nothing is taken to see."""
OFFSET_M = 1.0e-4
"""Distance from a surface at which a ray of reflection or shadow starts."""


class Ball(NamedTuple):
    """A sphere."""

    center_m: tuple[float, float, float]
    radius_m: float
    albedo: float = 0.7
    mirror: bool = False
    texture: float = 0.0
    """Depth of its texture, 0 to 1."""


class Wall(NamedTuple):
    """A rectangle, or a plane without end."""

    point_m: tuple[float, float, float]
    normal: tuple[float, float, float]
    albedo: float = 0.7
    mirror: bool = False
    texture: float = 0.0
    half_m: tuple[float, float] = (FAR_M, FAR_M)
    """Half of its width and of its height."""


Shape = Ball | Wall


def rectangle(x_m: tuple[float, float], y_m: tuple[float, float], depth_m: float, albedo: float = 0.6) -> Wall:
    """Return the rectangle that faces the camera, from and to these places."""
    return Wall((sum(x_m) / 2, sum(y_m) / 2, -depth_m), (0, 0, 1), albedo, half_m=((x_m[1] - x_m[0]) / 2, (y_m[1] - y_m[0]) / 2))


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Pinhole camera and projector; the camera frame has x right, y up, z backward."""

    camera: tuple[int, int] = (200, 150)
    camera_focal: float = 260.0
    projector: tuple[int, int] = (320, 240)
    projector_focal: float = 420.0
    position_m: tuple[float, float, float] = (-0.22, 0.03, 0.0)
    target_m: tuple[float, float, float] = (0.0, 0.0, -1.2)

    @property
    def pose(self) -> np.ndarray:
        """Return camera_from_projector, [4, 4]."""
        return np.asarray(look_at(self.position_m, self.target_m))


@dataclass(frozen=True, kw_only=True)
class World:
    """What stands before the rig, and how its light is recorded."""

    shapes: Sequence[Shape]
    rig: Rig = field(default_factory=Rig)
    fog: float = 0.0
    """Scattering coefficient of a fog without absorption, 1/m: single scattering, evenly in all directions."""
    ambient: float = 0.03
    light: float = 0.8
    """Reading of white on a white surface that faces the projector at 1 m."""
    tint: tuple[float, float, float] = (1.0, 0.6, 0.35)
    """Parts of that in red, green and blue, under patterns of colours."""
    blur_px: float = 0.4
    """Standard deviation of the projector's focus, projector pixels."""
    samples: int = 4
    """Samples along each side of a camera pixel."""
    gamma: float = 1.0
    mixed: float = 0.0
    """Part of the next pattern in each frame, as a camera records that is not synchronised."""
    scattered: float = 0.0
    """Part of the light that runs below the surface, to one side, before it leaves it."""
    scatter_px: float = 6.0
    """Mean distance of that, projector pixels."""
    flights: int = 1
    """Number of straight ways of that light between two turns: 1 leaves most of it near, more move all of it aside."""
    read_noise: float = 0.003
    electrons: float = 10000.0
    """At full scale."""
    bits: int = 12
    seed: int = 0


class Light(NamedTuple):
    """Light that comes from places of the projector to camera pixels, and the truth."""

    pixel: np.ndarray  # [n] int
    u: np.ndarray  # [n]
    v: np.ndarray  # [n]
    weight: np.ndarray  # [n]
    ambient: np.ndarray  # [pixels] reflectance under even ambient light
    depth: np.ndarray  # [rows, cols] metres through the pixel's centre; NaN where nothing or a mirror's image is seen
    lit: np.ndarray  # [rows, cols] bool: the projector reaches what the pixel's centre shows


def trace(world: World) -> Light:
    """Return where the light of each camera pixel comes from."""
    rig = world.rig
    width, height = rig.camera
    step = (np.arange(world.samples) + 0.5) / world.samples
    parts: list[tuple[np.ndarray, ...]] = []
    ambient = np.zeros(width * height)
    share = 1 / world.samples**2
    for down in step:
        for across in step:
            direction = _rays(rig, across, down)
            distance, normal, albedo, shape = meet(world.shapes, np.zeros(3), direction)
            point = direction * distance[:, None]
            pixel = np.arange(len(direction))
            seen, weight = point.copy(), np.full(len(direction), share)
            for _bounce in range(2):
                mirror = np.array([s.mirror for s in world.shapes] + [False])[shape]
                if not mirror.any():
                    break
                turned = direction - 2 * (direction * normal).sum(axis=1, keepdims=True) * normal
                again, other, colour, which = meet(world.shapes, seen[mirror] + OFFSET_M * normal[mirror], turned[mirror])
                seen[mirror] = seen[mirror] + turned[mirror] * again[:, None]
                direction = np.where(mirror[:, None], turned, direction)
                normal[mirror], albedo[mirror], shape[mirror] = other, colour, which
                weight[mirror] *= 0.9
            _add(world, parts, pixel, seen, normal, albedo, shape, weight, np.zeros(len(pixel)) if world.fog == 0 else distance)
            met = shape < len(world.shapes)
            ambient += np.where(met, albedo, 0) * share
            if world.fog > 0:
                _add_fog(world, parts, pixel, _rays(rig, across, down), distance, share)
    middle = _rays(rig, 0.5, 0.5)
    distance, normal, _, shape = meet(world.shapes, np.zeros(3), middle)
    depth = np.where(distance < FAR_M, -middle[:, 2] * distance, np.nan)
    cosine, _, _, _ = _lit(world, middle * distance[:, None], normal)
    return Light(*(np.concatenate(column) for column in zip(*parts, strict=True)), ambient,
                 depth.reshape(height, width), ((cosine > 0) & np.isfinite(depth)).reshape(height, width))


def _rays(rig: Rig, across: float, down: float) -> np.ndarray:
    width, height = rig.camera
    x, y = np.meshgrid(np.arange(width) + across, np.arange(height) + down)
    ray = np.stack([(x - width / 2) / rig.camera_focal, -(y - height / 2) / rig.camera_focal, -np.ones_like(x)], axis=-1).reshape(-1, 3)
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def meet(shapes: Sequence[Shape], origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return where rays first meet a shape.

    Args:
        shapes: the shapes.
        origin: [..., 3] where rays start, metres.
        direction: [..., 3] unit vectors.

    Returns:
        [...] distance, FAR_M where nothing is met; [..., 3] normal towards the origin; [...] albedo; [...] index of the shape, their number
        where nothing is met.
    """
    best = np.full(direction.shape[:-1], FAR_M)
    normal, albedo = np.zeros_like(direction), np.zeros(best.shape)
    index = np.full(best.shape, len(shapes))
    for number, shape in enumerate(shapes):
        if isinstance(shape, Ball):
            to = origin - np.array(shape.center_m)
            b = (direction * to).sum(axis=-1)
            root = b**2 - (to**2).sum(axis=-1) + shape.radius_m**2
            t = -b - np.sqrt(np.maximum(root, 0))
            t = np.where((root > 0) & (t > 0), t, FAR_M)
            place = origin + direction * t[..., None]
            facing = (place - shape.center_m) / shape.radius_m
            angles = np.arctan2(facing[..., 0], facing[..., 2]), np.arcsin(np.clip(facing[..., 1], -1, 1))
            flat = np.stack(angles, axis=-1) * shape.radius_m
        else:
            n = np.array(shape.normal) / np.linalg.norm(shape.normal)
            slope = direction @ n
            t = ((np.array(shape.point_m) - origin) @ n) / np.where(np.abs(slope) > 1e-12, slope, 1e-12)
            place = origin + direction * t[..., None]
            right = np.cross([0.0, 1.0, 0.0], n) if abs(n[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
            right = right / np.linalg.norm(right)
            flat = np.stack([(place - shape.point_m) @ right, (place - shape.point_m) @ np.cross(n, right)], axis=-1)
            t = np.where((t > 0) & (np.abs(flat) <= np.array(shape.half_m)).all(axis=-1), t, FAR_M)
            facing = -n * np.sign(slope)[..., None]
        nearer = t < best
        best = np.where(nearer, t, best)
        normal = np.where(nearer[..., None], facing, normal)
        x, y = flat[..., 0], flat[..., 1]
        check = np.sign(np.sin(x * 140) * np.sin(y * 140)) * 0.6 + 0.4 * np.sin(x * 900 + y * 300)
        albedo = np.where(nearer, shape.albedo * (1 - shape.texture * (0.5 + 0.5 * check)), albedo)
        index = np.where(nearer, number, index)
    return best, normal, albedo, index


def _lit(world: World, point: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return irradiance over that of a facing surface at 1 m (0 in shadow), and u, v and distance in the projector."""
    rig, pose = world.rig, world.rig.pose
    to = pose[:3, 3] - point
    far = np.linalg.norm(to, axis=1)
    to = to / far[:, None]
    cosine = np.clip((normal * to).sum(axis=1), 0, None)
    blocked = meet(world.shapes, point + OFFSET_M * normal, to)[0] < far - 2 * OFFSET_M
    local = (point - pose[:3, 3]) @ pose[:3, :3]
    ahead = local[:, 2] < -1e-6
    z = np.where(ahead, -local[:, 2], 1.0)
    u = rig.projector[0] / 2 + rig.projector_focal * local[:, 0] / z
    v = rig.projector[1] / 2 - rig.projector_focal * local[:, 1] / z
    inside = ahead & (u >= 0) & (u < rig.projector[0]) & (v >= 0) & (v < rig.projector[1])
    return np.where(inside & ~blocked, cosine / far**2, 0.0), u, v, far


def _add(world: World, parts: list[tuple[np.ndarray, ...]], pixel: np.ndarray, point: np.ndarray, normal: np.ndarray, albedo: np.ndarray,
         shape: np.ndarray, weight: np.ndarray, way: np.ndarray) -> None:
    strength, u, v, far = _lit(world, point, normal)
    value = strength * albedo * weight * np.exp(-world.fog * (way + far) * (world.fog > 0))
    kept = (value > 0) & (shape < len(world.shapes))
    parts.append((pixel[kept], u[kept], v[kept], value[kept]))


def _add_fog(world: World, parts: list[tuple[np.ndarray, ...]], pixel: np.ndarray, direction: np.ndarray, distance: np.ndarray,
             share: float, steps: int = 48) -> None:
    """Add the light that fog along the lines of sight scatters towards the camera."""
    length = np.minimum(distance, 4.0)
    rng = np.random.default_rng(1)
    for step in range(steps):
        t = length * (step + rng.random(len(length))) / steps
        point = direction * t[:, None]
        to = world.rig.pose[:3, 3] - point
        normal = to / np.linalg.norm(to, axis=1, keepdims=True)
        strength, u, v, far = _lit(world, point, normal)
        value = strength * share * world.fog / 4 * (length / steps) * np.exp(-world.fog * (t + far))  # albedo/π against 1/4π
        kept = value > 0
        parts.append((pixel[kept], u[kept], v[kept], value[kept]))


def images(world: World, light: Light | Sequence[Light], patterns: Sequence[Pattern]) -> np.ndarray:
    """Return the recorded images, [frames, rows, cols] 0…1, or [frames, rows, cols, 3] under patterns of colours; `light`: that of all
    frames, or one for each."""
    if any(isinstance(pattern, KaryPattern) and pattern.colors is not None for pattern in patterns):
        return np.stack([images(replace(world, light=world.light * part, seed=world.seed + channel), light,
                                [_channel(pattern, channel) for pattern in patterns]) for channel, part in enumerate(world.tint)], axis=-1)
    width, height = world.rig.camera
    rng = np.random.default_rng(world.seed)
    frames = np.empty((len(patterns), height, width))
    for number, pattern in enumerate(patterns):
        seen = light if isinstance(light, Light) else light[number]
        column, row = (np.floor(place * FINE).astype(int) for place in (seen.u, seen.v))
        following = patterns[(number + 1) % len(patterns)]
        light_of, then = (draw(each, world.rig.projector).astype(np.float64) ** world.gamma for each in (pattern, following))
        shown = _focus((1 - world.mixed) * light_of + world.mixed * then, world.blur_px)
        if world.scattered:
            away = np.arange(8 * world.scatter_px * FINE) / (world.scatter_px * FINE)
            kernel = away ** (world.flights - 1) * np.exp(-away * world.flights)
            below = convolve1d(shown, kernel / kernel.sum(), axis=1, mode="nearest", origin=-(len(kernel) // 2))
            shown = (1 - world.scattered) * shown + world.scattered * below
        recorded = np.bincount(seen.pixel, seen.weight * shown[row, column], width * height) * world.light
        recorded += seen.ambient * world.ambient
        recorded = rng.poisson(recorded * world.electrons) / world.electrons + rng.normal(0, world.read_noise, recorded.shape)
        frames[number] = np.clip(recorded, 0, 1).reshape(height, width)
    top = 2**world.bits - 1
    return np.rint(frames * top) / top


def _channel(pattern: Pattern, channel: int) -> Pattern:
    """Return what a projector shows of a pattern in one of its channels."""
    if not isinstance(pattern, KaryPattern) or pattern.colors is None:
        return pattern
    return pattern.model_copy(update={"levels": tuple(color[channel] for color in pattern.colors), "colors": None})


def _focus(shown: np.ndarray, blur_px: float) -> np.ndarray:
    """Return an image in pixels FINE times as fine, under a Gaussian point spread."""
    shown = np.repeat(np.repeat(shown, FINE, axis=0), FINE, axis=1)
    if blur_px <= 0:
        return shown
    blur_px = blur_px * FINE
    reach = int(np.ceil(4 * blur_px))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / blur_px) ** 2)
    kernel /= kernel.sum()
    return np.asarray(convolve1d(convolve1d(shown, kernel, axis=0, mode="nearest"), kernel, axis=1, mode="nearest"))


def write_capture(folder: Path, world: World, patterns: Sequence[Pattern], *, light: Light | None = None,
                  declared: Sequence[Pattern] | None = None, moments: Sequence[Light] | None = None,
                  aside: Sequence[tuple[float, float]] | None = None, **projector: Any) -> Light:
    """Write a capture of these patterns.

    Args:
        folder: where.
        world: what is seen.
        patterns: what is projected, frame by frame.
        light: of `trace`, where the same world is captured again.
        declared: what the manifest says instead; None: the truth.
        moments: light of each frame, where something moves.
        aside: by how many pixels each frame lies lower and farther right than the truth, where the camera moves.
        projector: further fields of the manifest's projector.

    Returns:
        The light, with the truth.
    """
    light = trace(world) if light is None else light
    rig, entries = world.rig, []
    for number, (frame, pattern) in enumerate(zip(images(world, moments or light, patterns), declared or patterns, strict=True)):
        name = f"{number:03d}.png"
        if aside is not None:
            frame = shift(frame, (*aside[number], *[0] * (frame.ndim - 2)), order=1, mode="nearest")
        write_image(folder / name, np.rint(frame * FULL_SCALE).astype(np.uint16))
        entries.append(Frame(image=name, pattern=pattern).model_dump(mode="json", exclude_defaults=True))
    write_manifest(folder, {
        "schema": "relit.capture/1", "name": folder.name, "color_space": "lin_rec709_scene",
        "camera": {"projection": "perspective", "resolution": rig.camera, "focal_px": [rig.camera_focal] * 2,
                   "principal_px": [rig.camera[0] / 2, rig.camera[1] / 2]},
        "projector": {"resolution": rig.projector, "focal_px": [rig.projector_focal] * 2,
                      "principal_px": [rig.projector[0] / 2, rig.projector[1] / 2], "camera_from_projector": rig.pose.tolist(),
                      **projector},
        "frames": entries})
    return light
