"""The owl's plumage: body, head, brows, tufts and wings as one smooth union, displaced and painted by feathers.

In centimetres, owl frame. The head has a frame of its own (`from_head`, `to_head`), so that it can look at the camera
while the body is turned away.
"""

from __future__ import annotations

import feathers as fe
import numpy as np
from meshing import Surface, gradient, mesh_of, vertex_normals

# Linear Rec.709 albedo.
CREAM = np.array([0.74, 0.62, 0.44])
WHITE = np.array([0.80, 0.75, 0.66])
BROWN = np.array([0.30, 0.145, 0.060])
DARK = np.array([0.070, 0.034, 0.018])
RUFOUS = np.array([0.52, 0.235, 0.075])
TAN = np.array([0.56, 0.38, 0.20])

DISC_CENTER, DISC_RADIUS = np.array([1.90, 5.10]), 2.35


def rotation(axis: int, degrees: float) -> np.ndarray:  # -> [3, 3], a_from_b
    """Return the right-handed rotation about a coordinate axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


OWL_FROM_HEAD = rotation(1, 17) @ rotation(2, -6)
HEAD_PIVOT = np.array([0.0, 4.0, 0.0])


def to_head(p: np.ndarray) -> np.ndarray:
    """Return points of the owl frame in the head frame."""
    return (p - HEAD_PIVOT) @ OWL_FROM_HEAD + HEAD_PIVOT


def from_head(p: np.ndarray) -> np.ndarray:
    """Return points of the head frame in the owl frame."""
    return (p - HEAD_PIVOT) @ OWL_FROM_HEAD.T + HEAD_PIVOT


def ellipsoid(p: np.ndarray, center, radii) -> np.ndarray:
    """Return the approximate distance to an ellipsoid, exact to first order at its surface."""
    q = (p - center) / radii
    k0, k1 = np.linalg.norm(q, axis=-1), np.linalg.norm(q / radii, axis=-1)
    return k0 * (k0 - 1) / np.maximum(k1, 1e-9)


def cone(p: np.ndarray, start, end, r0: float, r1: float) -> np.ndarray:
    """Return the distance to a segment whose radius runs from r0 to r1."""
    start, axis = np.asarray(start, float), np.subtract(end, start)
    t = np.clip((p - start) @ axis / (axis @ axis), 0, 1)
    return np.linalg.norm(p - start - t[..., None] * axis, axis=-1) - (r0 + (r1 - r0) * t)


def join(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Return the smooth union of two distances with a fillet of about k."""
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - 0.25 * k * h * h


def mirrored(p: np.ndarray) -> np.ndarray:
    """Fold the left half onto the right."""
    return np.stack([np.abs(p[..., 0]), p[..., 1], p[..., 2]], axis=-1)


def body(p: np.ndarray) -> np.ndarray:
    """Return the distance to torso and tail."""
    d = join(ellipsoid(p, [0, -3.0, 0.2], [4.3, 4.9, 4.0]), ellipsoid(p, [0, 0.6, 0.5], [4.25, 4.3, 3.8]), 1.6)
    return join(d, ellipsoid(p, [0, -6.4, -3.4], [2.4, 3.0, 1.0]), 0.8)


def head(p: np.ndarray) -> np.ndarray:
    """Return the distance to skull, brows and ear tufts."""
    q = mirrored(to_head(p))
    d = join(ellipsoid(q, [0, 5.0, 0.2], [4.6, 3.5, 3.9]), ellipsoid(q, [0, 4.2, 1.2], [3.8, 2.6, 3.2]), 1.0)
    d = join(d, cone(q, [0.1, 5.3, 4.0], [3.6, 7.7, 2.2], 0.45, 0.42), 0.7)
    return join(d, cone(q, [2.7, 7.2, 1.2], [4.35, 10.3, -0.2], 1.05, 0.05), 0.9)


def wing(p: np.ndarray) -> np.ndarray:
    """Return the distance to both folded wings, whose tips reach back and inwards."""
    q = (mirrored(p) - [4.15, -1.3, -0.3]) @ rotation(2, 9).T @ rotation(0, -14).T
    return ellipsoid(q, [0, 0, 0], [1.15, 5.6, 3.1])


def plumage(p: np.ndarray) -> np.ndarray:
    """Return the distance to everything that is feathered."""
    return join(join(body(p), head(p), 1.1), wing(p), 0.3)


def _coat(p: np.ndarray):
    """Return relief (cm), albedo [N, 3] and roughness at points of the plumage."""
    on_wing = fe.smoothstep(-0.12, 0.12, np.minimum(body(p), head(p)) - wing(p))
    on_head = fe.smoothstep(-0.35, 0.35, join(body(p), wing(p), 0.3) - head(p))
    lift, albedo, rough = _torso(p)
    for weight, (part_lift, part_albedo, part_rough) in ((on_head, _face(p)), (on_wing * (1 - on_head), _wings(p))):
        lift = fe.mix(lift, part_lift, weight)
        albedo = fe.mix(albedo, part_albedo, weight)
        rough = fe.mix(rough, part_rough, weight)
    return lift, albedo, rough


def _torso(p: np.ndarray):
    """Return the coat of the torso: cream breast with dark drops, brown flanks and back."""
    angle = np.arctan2(p[:, 0], p[:, 2])
    f = fe.lay(angle * 4.2 / 0.95, (5.0 - p[:, 1]) / 0.85)
    front = 1 - fe.smoothstep(0.85, 1.35, np.abs(angle) + 0.10 * fe.noise(p, 1.6, seed=3))
    bib = fe.smoothstep(0.5, 3.0, p[:, 1] + 0.5 * fe.noise(p, 1.5, seed=4))
    base = fe.mix(fe.mix(CREAM, TAN, 0.35 * (f.number > 0.6) + 0.15 * f.number), WHITE, bib * 0.8)
    drop = np.exp(-((f.across / (0.10 + 0.34 * fe.smoothstep(0.35, 0.85, f.along))) ** 4))
    drop *= fe.smoothstep(0.42, 0.55, f.along) * (1 - fe.smoothstep(0.86, 0.92, f.along)) * (f.number < 0.86)
    breast = fe.mix(base, fe.mix(DARK, RUFOUS, 0.35 * f.number), drop * (1 - 0.55 * bib))
    back = fe.mix(BROWN, DARK, fe.smoothstep(0.5, 0.9, f.along))
    return fe.relief(f, thickness=0.13), fe.mix(back, breast, front), 0.62 - 0.10 * drop


def _wings(p: np.ndarray):
    """Return the coat of the wings: small coverts at the shoulder, long barred flight feathers, satin glaze."""
    q = mirrored(p)
    down = np.clip(4.4 - p[:, 1], 0, None)
    v = 7.0 * (1 - np.exp(-down / 5.4))  # rows 0.8 cm apart at the shoulder, 4 times that at the tip
    around = np.arctan2(q[:, 2] + 0.4, q[:, 0] - 1.8)
    f = fe.lay(around * 3.0 / 1.02 + 0.1 * down, v, reach=2.0, taper=0.30, width=1.2)
    bars = fe.smoothstep(-0.15, 0.25, np.sin(2 * np.pi * (f.along * (1.2 + 0.45 * f.row) + 0.12 * np.abs(f.across))))
    base = fe.mix(fe.mix(BROWN, RUFOUS, 0.25 + 0.6 * f.number), DARK, 0.75 * bars * fe.smoothstep(0.2, 0.5, f.along))
    fringe = fe.smoothstep(0.86, 0.94, f.along)
    spot = np.exp(-(((f.across / 0.55) ** 2 + ((f.along - 0.80) / 0.12) ** 2) ** 2)) * (np.mod(f.row, 3) == 2) * (f.row > 0)
    albedo = fe.mix(fe.mix(base, TAN, 0.75 * fringe), WHITE, 0.95 * spot)
    thickness = 0.13 + 0.02 * np.clip(f.row, 0, 5)
    return fe.relief(f, thickness=thickness, barbs=0.05), albedo, 0.36 + 0.14 * fringe


def _face(p: np.ndarray):
    """Return the coat of the face: facial discs with a dark ruff, pale brows, speckled crown, dark tufts."""
    h = to_head(p)
    q = mirrored(h)
    f = fe.lay(np.arctan2(h[:, 0], h[:, 2] + 0.5) * 3.9 / 0.72, (10.5 - h[:, 1]) / 0.62, reach=2.0)
    base = fe.mix(fe.mix(BROWN, RUFOUS, 0.6 * f.number), DARK, fe.smoothstep(0.35, 0.75, f.along))
    albedo = fe.mix(base, TAN, fe.smoothstep(0.88, 0.95, f.along) * (0.4 + 0.6 * f.number))
    lift, rough = fe.relief(f, thickness=0.085), np.full(len(p), 0.55)

    toward = q[:, :2] - DISC_CENTER
    radius = np.linalg.norm(toward * [1.0, 0.94], axis=1)
    spoke = np.arctan2(toward[:, 1], toward[:, 0])
    facing = fe.smoothstep(0.6, 1.6, h[:, 2])
    brow = (1 - fe.smoothstep(0.45, 0.85, cone(q, [0.1, 5.3, 4.2], [3.6, 7.7, 2.4], 0.12, 0.10))) * facing
    disc = (1 - fe.smoothstep(DISC_RADIUS - 0.12, DISC_RADIUS + 0.12, radius)) * facing * (1 - brow)
    ruff = np.exp(-(((radius - DISC_RADIUS - 0.05) / 0.24) ** 2)) * facing * (1 - brow)
    wave = 0.5 + 0.5 * np.sin(spoke * 46 + 2.2 * np.sin(spoke * 7) + radius * 2.0)
    rings = fe.smoothstep(0.2, 0.8, 0.5 + 0.5 * np.sin(radius * 9.5 + 0.5 * np.sin(spoke * 5)))
    disc_albedo = fe.mix(fe.mix(WHITE, TAN, 0.75 * rings), RUFOUS, 0.45 * fe.smoothstep(1.3, 2.3, radius))
    disc_albedo = fe.mix(disc_albedo, DARK, 0.85 * (1 - fe.smoothstep(1.22, 1.55, radius)))
    disc_albedo = disc_albedo * (0.80 + 0.20 * wave[:, None])
    lift = fe.mix(lift, 0.05 * wave - 0.30 * (1 - (np.minimum(radius, DISC_RADIUS) / DISC_RADIUS) ** 2), disc)
    lift = lift + 0.20 * ruff
    albedo = fe.mix(fe.mix(albedo, disc_albedo, disc), fe.mix(DARK, BROWN, 0.5 * wave), 0.92 * ruff)
    streak = 0.5 + 0.5 * np.sin(30 * (q[:, 0] * 0.50 - q[:, 1] * 0.87) + 9 * q[:, 0] + 0.7 * fe.noise(q, 1.2, seed=5))
    lift = fe.mix(lift, 0.05 * streak, brow)
    albedo = fe.mix(albedo, fe.mix(WHITE, TAN, 0.45 * streak), brow)
    return lift, albedo, rough


def plumage_surface(detail: float) -> Surface:
    """Build the feathered mesh; `detail` is its final edge length in centimetres."""
    points, faces = mesh_of(plumage, [-6.6, -10.5, -6.2], [6.6, 11.6, 6.4], detail, step=0.02)
    lift, albedo, rough = _coat(points)
    points = points + lift[:, None] * gradient(plumage, points, step=0.05)
    return Surface(points, faces, vertex_normals(points, faces), albedo, np.full(len(points), 0.04), rough)
