"""The environment of the owl sample: a late afternoon with a low sun, haze, thin clouds, hills, and a cool softbox."""

from __future__ import annotations

import numpy as np
from feathers import noise, smoothstep

SUN_DIRECTION = np.array([-0.62, 0.36, 0.70]) / np.linalg.norm([-0.62, 0.36, 0.70])
SUN_DIAMETER_DEGREES = 3.0  # six times the real one, so that a 256-pixel map still holds its shape
SUN_TO_SKY_IRRADIANCE = 2.0  # on a surface facing the sun, against the sky on a level one
SUN_COLOR = np.array([1.0, 0.70, 0.42])
BOX_DIRECTION = np.array([0.88, 0.30, 0.10]) / np.linalg.norm([0.88, 0.30, 0.10])
BOX_HALF_DEGREES = (12.0, 20.0)  # across, up
BOX_RADIANCE = np.array([2.3, 3.2, 4.6])
SUPERSAMPLES = 4  # per pixel side, against stair steps
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def directions(width: int, height: int) -> np.ndarray:  # -> [H, W, 3] unit, from the object
    """Return the pixel-centre directions of a lat-long map: +y at the top, +z at the image centre, +x a quarter from the left."""
    u = (np.arange(width) + 0.5) / width * 2 * np.pi
    v = (np.arange(height) + 0.5) / height * np.pi
    ring = np.sin(v)[:, None]
    up = np.broadcast_to(np.cos(v)[:, None], (height, width))
    return np.stack([np.sin(u) * ring, up, -np.cos(u) * ring], axis=-1)


def solid_angles(width: int, height: int) -> np.ndarray:  # -> [H, 1] steradians
    """Return the solid angle of a pixel in each row: sin(pi v) (pi / H) (2 pi / W)."""
    v = (np.arange(height) + 0.5) / height * np.pi
    return (np.sin(v) * (np.pi / height) * (2 * np.pi / width))[:, None]


def _scenery(d: np.ndarray) -> np.ndarray:  # [N, 3] -> [N, 3]
    """Return sky, hills, ground and softbox, without the sun."""
    up, to_sun = d[:, 1], d @ SUN_DIRECTION
    level = smoothstep(0.0, 0.55, up)[:, None]
    sunward = (0.5 + 0.5 * to_sun)[:, None]
    horizon = np.array([0.62, 0.62, 0.70]) * (1 - sunward**2) + np.array([1.75, 1.02, 0.52]) * sunward**2
    sky = horizon * (1 - level) + np.array([0.20, 0.38, 0.82]) * level
    sky = sky + (
        np.array([3.0, 1.7, 0.8]) * np.exp((to_sun[:, None] - 1) * 14) + 9.0 * SUN_COLOR * np.exp((to_sun[:, None] - 1) * 160)
    )

    flat = d / np.maximum(up + 0.22, 0.05)[:, None] * [1.0, 0.0, 1.0]  # a cloud layer overhead, seen in perspective
    cover = noise(flat, 1.9, seed=21) + 0.5 * noise(flat, 0.7, seed=22) + 0.25 * noise(flat, 0.3, seed=23)
    cover = (smoothstep(0.2, 1.6, cover) * smoothstep(0.02, 0.2, up))[:, None]
    cloud = np.array([0.75, 0.72, 0.78]) + np.array([2.2, 1.35, 0.75]) * sunward**5
    sky = sky + (cloud - sky) * 0.75 * cover

    azimuth = np.arctan2(d[:, 0], d[:, 2])
    crest = 0.05 + 0.030 * np.sin(3 * azimuth + 1) + 0.018 * np.sin(7 * azimuth + 2) + 0.007 * np.sin(23 * azimuth)
    hill = smoothstep(0.006, -0.006, up - crest)[:, None]
    haze = 0.45 + 0.35 * sunward**3
    sky = sky + (horizon * 0.55 * haze + np.array([0.03, 0.05, 0.06]) - sky) * hill

    near = d / np.maximum(-up, 0.03)[:, None] * [1.0, 0.0, 1.0]
    patch = 1 + 0.18 * noise(near, 1.4, seed=24) + 0.12 * noise(near, 0.45, seed=25)
    ground = np.array([0.36, 0.235, 0.12]) * np.clip(patch, 0.3, 2)[:, None] * (0.7 + 0.5 * sunward)
    below = smoothstep(0.004, -0.03, up)[:, None]
    picture = sky + (ground - sky) * below

    side = np.cross([0.0, 1.0, 0.0], BOX_DIRECTION)
    side /= np.linalg.norm(side)
    lift = np.cross(BOX_DIRECTION, side)
    front = d @ BOX_DIRECTION
    x = np.degrees(np.arctan2(d @ side, front)) / BOX_HALF_DEGREES[0]
    y = np.degrees(np.arctan2(d @ lift, front)) / BOX_HALF_DEGREES[1]
    box = smoothstep(1.04, 0.92, np.maximum(np.abs(x), np.abs(y))) * (front > 0)
    falloff = 1 - 0.35 * np.minimum(x * x + y * y, 1.5)
    return picture + (BOX_RADIANCE * falloff[:, None] - picture) * box[:, None]


def make_sky(width: int = 256, height: int = 128) -> np.ndarray:  # -> [H, W, 3] half, linear Rec.709 radiance
    """Build the lat-long map, each pixel the mean over its area."""
    s = SUPERSAMPLES
    fine = directions(width * s, height * s).reshape(-1, 3)
    scenery = _scenery(fine).reshape(height, s, width, s, 3).mean(axis=(1, 3))
    s = 4 * SUPERSAMPLES
    inside = directions(width * s, height * s) @ SUN_DIRECTION > np.cos(np.radians(SUN_DIAMETER_DEGREES / 2))
    coverage = inside.reshape(height, s, width, s).mean(axis=(1, 3))
    omega = solid_angles(width, height)
    up = np.clip(directions(width, height)[..., 1], 0, None)
    level_irradiance = ((scenery @ LUMINANCE) * up * omega).sum()
    sun_radiance = SUN_TO_SKY_IRRADIANCE * level_irradiance / (coverage * omega).sum() / (SUN_COLOR @ LUMINANCE)
    return (scenery + coverage[..., None] * sun_radiance * SUN_COLOR).astype(np.float16)


def as_mitsuba_envmap(mi, environment: np.ndarray, *, upsample: int = 8) -> dict:
    """Return an emitter that shows every pixel of a lat-long map [H, W, 3] as a constant patch.

    Convention: Mitsuba's `envmap` has these axes (its centre looks along +z) and pixel-centred columns, but
    puts its first and last rows on the poles, and it interpolates. So rows are resampled to theta = pi j / (rows - 1)
    by nearest pixel on a grid fine enough for the interpolation not to matter.
    """
    height = len(environment)
    rows = height * upsample + 1
    row = np.minimum((np.arange(rows) / (rows - 1) * height).astype(int), height - 1)
    fine = np.repeat(environment.astype(np.float32)[row], upsample, axis=1)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(fine))}
