"""Objects of several parts with breaks of depth between them, for make_parts.py: signed distances, and materials at points.

Everything here is in metres, in the camera frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from feathers import mix, noise, smoothstep
from meshing import Distance, gradient, mesh_of

FIELD_M = 0.2
"""Side of the square that the camera sees."""
CM = 0.01


class Paint(NamedTuple):
    """Materials at points: a dielectric and a metal, and how much of each."""

    dielectric: np.ndarray  # [V, 3] base colour
    metal: np.ndarray  # [V, 3] base colour, the F0 of the metal
    roughness: np.ndarray  # [V] of both
    share: np.ndarray  # [V] of the metal, 0…1


class Part(NamedTuple):
    """A part that touches no other one."""

    distance: Distance  # of points in centimetres
    lower: tuple[float, float, float]  # cm, of a box around it
    upper: tuple[float, float, float]
    paint: Callable[[np.ndarray], Paint]  # of points in centimetres
    beyond: Mapping[str, float] = MappingProxyType({})  # further parameters of Mitsuba's `principled`: what no map of Relit's holds


class PartMesh(NamedTuple):
    """A part as triangles."""

    points: np.ndarray  # [V, 3] m
    faces: np.ndarray  # [F, 3]
    normals: np.ndarray  # [V, 3]
    paint: Paint
    beyond: Mapping[str, float]  # as of the part


def build(part: Part, *, detail: float) -> PartMesh:
    """Mesh a part with edges of about `detail` centimetres."""
    points, faces = mesh_of(part.distance, part.lower, part.upper, detail)
    return PartMesh(points * CM, faces, gradient(part.distance, points, step=0.005), part.paint(points), part.beyond)


def _capsule(p: np.ndarray, start, end, thick: float, thin: float) -> np.ndarray:
    start, end = np.array(start, float), np.array(end, float)
    t = np.clip((p - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    return np.linalg.norm(p - start - t[..., None] * (end - start), axis=-1) - (thick + (thin - thick) * t)


def _join(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - 0.25 * k * h * h


def _metal(colour: list[float], roughness: float) -> Callable[[np.ndarray], Paint]:
    """Return the paint of a bare metal."""
    return lambda p: Paint(np.full((len(p), 3), 0.5), np.tile(colour, (len(p), 1)), np.full(len(p), roughness), np.ones(len(p)))


def _dielectric(colour: list[float], roughness: float) -> Callable[[np.ndarray], Paint]:
    """Return the paint of a dielectric of one colour."""
    return lambda p: Paint(np.tile(colour, (len(p), 1)), np.full((len(p), 3), 0.6), np.full(len(p), roughness), np.zeros(len(p)))


def _lumpy(p: np.ndarray) -> np.ndarray:
    """Return the distance to a lumpy body of about 7.5 cm radius."""
    q = p - [-0.6, -0.7, 0]
    radius = np.linalg.norm(q * [1.0, 0.93, 1.1], axis=-1)
    unit = q / np.maximum(np.linalg.norm(q, axis=-1), 1e-9)[..., None]
    lumps = np.sin(4 * unit[..., 0] + 0.5) * np.cos(5 * unit[..., 1] - 0.4) + np.sin(3 * unit[..., 2] + 5 * unit[..., 1] * unit[..., 0])
    return 0.8 * (radius - 7.4 - 0.28 * lumps)


def _lumpy_paint(p: np.ndarray) -> Paint:
    colour = mix(np.array([0.55, 0.16, 0.10]), np.array([0.70, 0.55, 0.30]), smoothstep(-1.5, 1.5, noise(p, 5.0, seed=31)))
    across = p @ np.array([0.55, 0.80, 0.24])
    share = smoothstep(-3.4, -2.9, across) * smoothstep(-0.6, -1.5, across)  # a narrow and a wide border, 3 and 6 pixels
    return Paint(colour, np.tile([0.92, 0.74, 0.40], (len(p), 1)), 0.32 + 0.22 * smoothstep(-2, 2, noise(p, 6.0, seed=32)), share)


def _folded(p: np.ndarray) -> np.ndarray:
    """Return the distance to a torso with folds across it, and a head-like knob."""
    q = p - [0.0, -1.6, -1.0]
    trunk = np.linalg.norm(q * [1.0, 0.82, 1.25], axis=-1) - 6.1
    slope = q[..., 1] + 0.35 * q[..., 0] + 0.5 * np.sin(0.9 * q[..., 0])
    folds = np.maximum(np.sin(1.9 * slope), -0.35) * smoothstep(5.5, 2.5, np.abs(q[..., 1] + 1.0))
    knob = np.linalg.norm(p - [0.5, 6.4, -0.6], axis=-1) - 2.5
    return 0.6 * _join(trunk - 0.42 * folds, knob, 1.2)


def _cloth(p: np.ndarray) -> Paint:
    colour = mix(np.array([0.12, 0.26, 0.42]), np.array([0.62, 0.60, 0.52]), smoothstep(-1.0, 1.0, noise(p, 3.5, seed=41)))
    roughness = 0.2 + 0.4 * smoothstep(-1.5, 1.5, noise(p, 4.5, seed=42))
    return Paint(colour, np.full((len(p), 3), 0.6), roughness, np.zeros(len(p)))


def _ring(p: np.ndarray) -> np.ndarray:
    """Return the distance to a tilted ring before the chest."""
    axis = np.array([0.35, 0.30, 0.89]) / np.linalg.norm([0.35, 0.30, 0.89])
    q = p - [1.9, 1.2, 6.4]
    along = q @ axis
    return np.hypot(np.linalg.norm(q - along[..., None] * axis, axis=-1) - 2.7, along) - 0.62


def _vase(p: np.ndarray) -> np.ndarray:
    """Return the distance to a vase with a neck, turned about y."""
    x, y, z = np.moveaxis(p - [1.6, -0.5, -2.0], -1, 0)
    bulges = ((2.2, -2.5, 3.0), (-0.9, 4.2, 1.6), (0.5, 7.4, 0.8))
    profile = 2.4 + sum(wide * np.exp(-(((y - at) / long) ** 2)) for wide, at, long in bulges)
    return np.maximum(0.75 * (np.hypot(x, z) - profile), np.abs(y - 0.3) - 7.2) - 0.15


def _glazed_bands(p: np.ndarray) -> Paint:
    bands = smoothstep(-0.15, 0.15, np.sin(1.1 * p[..., 1] + 0.6 * np.sin(p[..., 0])))
    colour = mix(np.array([0.06, 0.20, 0.10]), np.array([0.72, 0.64, 0.50]), bands)
    return Paint(colour, np.full((len(p), 3), 0.6), 0.18 + 0.22 * smoothstep(-1.0, 1.0, noise(p, 4.0, seed=51)), np.zeros(len(p)))


def _box(p: np.ndarray, half: tuple[float, float, float], rounding: float) -> np.ndarray:
    q = np.abs(p) - np.array(half)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0) - rounding


def _facing(p: np.ndarray, centre: tuple[float, ...], axis: tuple[float, ...], up: tuple[float, ...]) -> np.ndarray:
    """Return points in a frame at `centre` whose z is `axis` and whose x stands on `up`."""
    z = np.array(axis) / np.linalg.norm(axis)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return (p - centre) @ np.stack([x, np.cross(x, z), z], axis=1)


def _plate(p: np.ndarray) -> np.ndarray:
    """Return the distance to a plate that leans, left of the vase and before it."""
    return _box(_facing(p, (-4.6, -3.4, 4.0), (0.45, 0.25, 0.86), (0, 1, 0)), (2.2, 2.6, 0.05), 0.35)


def _copper_stripes(p: np.ndarray) -> Paint:
    count, share = len(p), smoothstep(-0.2, 0.2, np.sin(2.2 * (0.8 * p[..., 0] + 0.6 * p[..., 1])))
    return Paint(np.tile([0.10, 0.10, 0.45], (count, 1)), np.tile([0.86, 0.52, 0.36], (count, 1)), np.full(count, 0.42), share)


def _turned_box(p: np.ndarray) -> np.ndarray:
    """Return the distance to a rounded cube, turned about two axes, at the foot of the vase."""
    x, y, z = np.moveaxis(p - [3.2, -5.6, 5.2], -1, 0)
    across, along = np.cos(0.6) * x + np.sin(0.6) * z, np.cos(0.6) * z - np.sin(0.6) * x
    return _box(np.stack([across, 0.94 * y + 0.34 * along, 0.94 * along - 0.34 * y], axis=-1), (1.0, 1.0, 1.0), 0.5)


def _in_frame(p: np.ndarray, centre: tuple[float, float, float], up: tuple[float, float, float]) -> tuple[np.ndarray, ...]:
    """Return x, y and z of points in a frame at `centre` whose y is `up`."""
    y = np.array(up) / np.linalg.norm(up)
    x = np.cross(y, [0, 0, 1])
    x /= np.linalg.norm(x)
    return tuple(np.moveaxis((p - centre) @ np.stack([x, y, np.cross(x, y)], axis=1), -1, 0))


MUG = (-1.2, 0.6, -1.0), (0.05, 0.88, 0.47)


def _mug(p: np.ndarray) -> np.ndarray:
    """Return the distance to a mug that one looks into, its handle on the right."""
    x, y, z = _in_frame(p, *MUG)
    radius = np.hypot(x, z)
    cup = np.maximum(np.maximum(radius - 4.0, np.abs(y) - 4.4), -np.maximum(radius - 3.4, -(y + 3.8)))
    handle = np.hypot(np.hypot(x - 4.3, y) - 2.3, z) - 0.55
    return 0.7 * (_join(cup, np.maximum(handle, 3.6 - radius), 0.5) - 0.12)


def _half_glazed(p: np.ndarray) -> Paint:
    x, y, z = _in_frame(p, *MUG)
    glazed = smoothstep(-1.1, -0.8, y + 0.3 * np.sin(2 * np.arctan2(z, x)))
    colour = mix(np.array([0.50, 0.27, 0.16]), np.array([0.10, 0.30, 0.42]), glazed)
    return Paint(colour, np.full((len(p), 3), 0.6), 0.65 - 0.48 * glazed, np.zeros(len(p)))


def _coin(p: np.ndarray) -> np.ndarray:
    """Return the distance to a coin with a rim and three rays, which leans before the mug."""
    x, y, z = _in_frame(p, (-4.6, -5.6, 4.6), (0.25, 0.30, 0.92))
    radius = np.hypot(x, z)
    relief = 0.10 * smoothstep(-0.3, 0.3, np.sin(3 * np.arctan2(z, x)) * np.clip(2.4 - radius, 0, 1)) + 0.12 * smoothstep(2.25, 2.4, radius)
    return 0.6 * (np.maximum(radius - 2.7, np.abs(y) - 0.22 - relief) - 0.08)


def _carved(p: np.ndarray) -> np.ndarray:
    """Return the distance to a carved mask: a shield with a nose, brows, and grooves of sharp edges."""
    x, y, z = np.moveaxis(p, -1, 0)
    shield = np.sqrt((x / 6.6) ** 2 + (y / 8.2) ** 2 + ((z + 3) / 4.6) ** 2)
    base = (shield - 1) * 4.6
    nose = _capsule(p, (0, 2.6, 1.3), (0, -1.4, 2.6), 0.5, 1.0)
    brows = np.minimum(*(_capsule(p, (side, 2.9, 1.6), (4.2 * side, 3.6, 0.2), 0.55, 0.35) for side in (-1.0, 1.0)))
    groove = np.abs(np.hypot(x, 1.3 * (y + 3.6)) - 2.4) - 0.42  # around the mouth
    lines = np.abs(np.mod(x - 0.25 * y, 1.6) - 0.8) - 0.3 + 2 * np.maximum(4.6 - y, 0)  # on the forehead
    cut = np.maximum(base, -(np.minimum(groove, lines) + np.abs(base + 0.05)))
    return 0.6 * np.minimum(_join(cut, nose, 0.5), _join(cut, brows, 0.2))


def _painted_mask(p: np.ndarray) -> Paint:
    x, y, _ = np.moveaxis(p, -1, 0)
    white, black = np.array([0.82, 0.80, 0.76]), np.array([0.025, 0.025, 0.03])
    red = np.array([0.55, 0.035, 0.03])
    sides = smoothstep(-0.04, 0.04, np.abs(x) - 3.0 - 0.6 * np.sin(1.5 * y))
    eyes = smoothstep(0.05, -0.05, np.hypot(np.abs(x) - 2.2, 1.6 * (y - 1.3)) - 1.1)
    colour = mix(mix(white, red, sides), black, eyes)
    varnish = smoothstep(-0.1, 0.1, noise(p, 3.0, seed=61))
    return Paint(colour, np.full((len(p), 3), 0.6), 0.6 - 0.34 * varnish, np.zeros(len(p)))


def _link(p: np.ndarray, centre, axis, long: float) -> np.ndarray:
    """Return the distance to a link of a chain: a torus stretched along y of its frame."""
    x, y, z = _in_frame(p, centre, axis)
    y = y - np.clip(y, -long, long)
    return np.hypot(np.hypot(x, y) - 0.9, z) - 0.3


def _chain(p: np.ndarray) -> np.ndarray:
    links = [((-5.2, 4.6, 3.0), (0.62, -0.78, 0.0)), ((-3.2, 2.1, 4.4), (0.5, -0.6, 0.62)), ((-1.4, -0.4, 5.6), (0.62, -0.78, 0.1))]
    return np.minimum.reduce([_link(p, centre, axis, 1.0) for centre, axis in links])


def _leaf(p: np.ndarray) -> np.ndarray:
    x, y, z = _in_frame(p, (4.2, -4.0, 3.4), (0.55, 0.8, 0.25))
    sheet = np.abs(z - 0.09 * x * x - 0.05 * y * y + 0.2 * np.abs(x)) - 0.12
    return 0.5 * (np.maximum.reduce([sheet, np.abs(x) - 1.9 * (1 - (y / 4.2) ** 2), np.abs(y) - 4.1]) - 0.05)


def _blade(p: np.ndarray) -> np.ndarray:
    return _box(_facing(p, (-4.4, -5.4, 4.8), (0.30, 0.52, 0.80), (0.8, 0.6, 0)), (0.9, 3.2, 0.08), 0.1)


def _cushion(p: np.ndarray) -> np.ndarray:
    """Return the distance to a cushion with three deep buttons and folds around the lowest."""
    x, y, z = np.moveaxis(p, -1, 0)
    across = ((np.abs(x) / 8.2) ** 4 + (np.abs(y) / 7.4) ** 4) ** 0.25
    body = (np.sqrt(across**2.6 + ((z + 2) / 4.2) ** 2) - 1) * 3.2
    for middle in ((-2.6, 1.6), (2.6, 1.6), (0, -2.6)):
        r = np.hypot(x - middle[0], y - middle[1])
        body = body + np.exp(-((r / 0.75) ** 2)) + 0.35 * np.exp(-((r / 2.0) ** 2))
    folds = 0.12 * np.sin(5 * np.arctan2(y + 2.6, x)) * np.exp(-(((np.hypot(x, y + 2.6) - 2.2) / 1.2) ** 2))
    return 0.6 * (body + folds)


def _velvet(p: np.ndarray) -> Paint:
    x, y, _ = np.moveaxis(p, -1, 0)
    stripes = smoothstep(-0.1, 0.1, np.sin(1.1 * (x + y)))
    colour = mix(np.array([0.22, 0.03, 0.05]), np.array([0.05, 0.06, 0.20]), stripes)
    return Paint(colour, np.full((len(p), 3), 0.6), np.full(len(p), 0.8), np.zeros(len(p)))


def _apple(p: np.ndarray) -> np.ndarray:
    x, y, z = _in_frame(p, (3.4, -3.4, 4.6), (0.25, 0.9, 0.4))
    return 0.7 * (np.hypot(np.hypot(x, z) - 1.0, y) - 1.55 + 0.075 * y)


def _apple_paint(p: np.ndarray) -> Paint:
    spots = smoothstep(-0.6, 0.6, noise(p, 1.2, seed=7) + 0.6 * np.sin(1.3 * p[:, 0]))
    colour = mix(np.array([0.45, 0.02, 0.02]), np.array([0.55, 0.40, 0.05]), spots)
    return Paint(colour, np.full((len(p), 3), 0.6), np.full(len(p), 0.55), np.zeros(len(p)))


def _disc(p: np.ndarray) -> np.ndarray:
    """Return the distance to a slightly hollow disc."""
    x, y, z = _in_frame(p, (-3.4, 3.8, 4.8), (0.35, -0.3, 0.88))
    return 0.8 * np.maximum(np.hypot(x, y) - 2.9, np.abs(z - 0.03 * (x * x + y * y)) - 0.25) - 0.05


STEEL = _metal([0.63, 0.60, 0.57], 0.36)
SCENES: dict[str, dict[str, Part]] = {
    "two_parts": {
        "body": Part(_lumpy, (-9.9, -9.9, -9.0), (8.7, 8.9, 9.0), _lumpy_paint),
        "ball": Part(lambda p: np.linalg.norm(p - [2.3, 2.6, 9.0], axis=-1) - 2.6, (-0.6, -0.3, 6.1), (5.2, 5.5, 11.9), STEEL),
    },
    "figure": {
        "torso": Part(_folded, (-7.6, -10.4, -7.6), (7.6, 9.6, 5.6), _cloth),
        "ring": Part(_ring, (-2.0, -2.7, 3.5), (5.8, 5.1, 9.3), _metal([0.95, 0.70, 0.30], 0.28)),
        "arm": Part(lambda p: _capsule(p, (-5.6, 1.0, 3.6), (1.6, -5.2, 6.8), 1.25, 0.8), (-7.3, -6.8, 1.9), (3.3, 2.7, 8.4),
                    _dielectric([0.66, 0.42, 0.30], 0.45)),
    },
    "still": {
        "vase": Part(_vase, (-5.0, -9.4, -8.2), (8.2, 9.0, 4.2), _glazed_bands),
        "plate": Part(_plate, (-8.2, -7.4, 1.2), (-1.0, 0.6, 6.8), _copper_stripes),
        "egg": Part(lambda p: 0.8 * (np.linalg.norm((p - [3.4, 3.2, 5.6]) * [1.0, 0.78, 1.0], axis=-1) - 1.7),
                    (1.3, 0.6, 3.5), (5.5, 5.8, 7.7), _dielectric([0.75, 0.73, 0.68], 0.7)),
        "cube": Part(_turned_box, (0.8, -8.2, 2.6), (5.8, -3.0, 7.8), STEEL),
    },
    "desk": {
        "mug": Part(_mug, (-7.5, -7.5, -8.0), (8.0, 8.0, 6.0), _half_glazed),
        "coin": Part(_coin, (-8.0, -9.2, 1.6), (-1.2, -2.2, 7.6), _metal([0.95, 0.72, 0.34], 0.3)),
        "stick": Part(lambda p: _capsule(p, (-8.2, 4.0, 6.5), (3.0, -8.6, 7.2), 0.28, 0.2), (-9.0, -9.4, 5.7), (3.8, 4.8, 8.0),
                      _dielectric([0.62, 0.50, 0.30], 0.55)),
        "rubber": Part(lambda p: np.linalg.norm(p - [4.6, -5.6, 5.2], axis=-1) - 2.2, (2.0, -8.2, 2.6), (7.2, -3.0, 7.8),
                       _dielectric([0.03, 0.03, 0.035], 0.35)),
    },
    "carved": {
        "mask": Part(_carved, (-7.4, -9.0, -8.4), (7.4, 9.0, 5.0), _painted_mask),
        "chain": Part(_chain, (-8.4, -4.2, 1.0), (1.6, 7.8, 7.8), _metal([0.90, 0.72, 0.38], 0.24)),
        "leaf": Part(_leaf, (-0.4, -9.4, 0.4), (9.2, 1.2, 8.0), _dielectric([0.05, 0.30, 0.04], 0.25)),
        "blade": Part(_blade, (-8.8, -9.8, 1.0), (0.4, -0.8, 8.8), _metal([0.63, 0.60, 0.57], 0.2)),
    },
    "atelier": {
        "cushion": Part(_cushion, (-9.4, -8.8, -7.4), (9.4, 8.8, 4.0), _velvet, {"sheen": 1.0, "sheen_tint": 0.5}),
        "apple": Part(_apple, (-0.4, -7.4, 0.6), (7.2, 0.8, 8.8), _apple_paint, {"clearcoat": 1.0, "clearcoat_gloss": 0.95}),
        "disc": Part(_disc, (-7.4, -0.2, 1.6), (0.6, 7.8, 8.2), _metal([0.72, 0.70, 0.66], 0.32), {"anisotropic": 0.8}),
    },
}
"""The parts of each object by name; part.Y of truth.exr counts them from 1."""
