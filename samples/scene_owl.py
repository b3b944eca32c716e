"""The owl of samples/owl: a figurine on a stump, put together in the camera frame.

Modelled as signed distances and swept curves in centimetres; the plumage is in owl_plumage.py.
"""

from __future__ import annotations

import feathers as fe
import numpy as np
from meshing import Surface, bezier, gradient, mesh_of, sphere, tube, vertex_normals
from owl_plumage import DARK, from_head, plumage_surface, rotation

METRES = 0.00915  # per unit of this file: the figurine stands 0.2 m tall
CENTER = np.array([0.0, -0.53, 0.0])  # of the model as the camera sees it, in units of this file
CAMERA_FROM_OWL = rotation(0, 9) @ rotation(1, -22)

# Linear Rec.709 albedo.
AMBER = np.array([0.90, 0.40, 0.02])
HORN = np.array([0.60, 0.44, 0.17])
SKIN = np.array([0.58, 0.40, 0.13])
BARK = np.array([0.21, 0.15, 0.105])
WOOD = np.array([0.60, 0.42, 0.25])
MOSS = np.array([0.14, 0.22, 0.035])

PUPIL, RIM = 0.46, 0.98  # radians from an eye's axis
EYE_CENTER, EYE_RADIUS = np.array([1.78, 5.30, 3.00]), 1.38


def eye_surfaces() -> list[Surface]:
    """Build the glazed eyes: black pupil, streaked amber iris, dark rim."""
    surfaces = []
    for side in (-1, 1):
        unit_points, faces, unit = sphere([0, 0, 0], EYE_RADIUS)
        turn = rotation(1, 3.0 * side)
        points = from_head(EYE_CENTER * [side, 1, 1] + unit_points @ turn.T)
        polar, spoke = np.arccos(np.clip(unit[:, 2], -1, 1)), np.arctan2(unit[:, 1], unit[:, 0])
        streak = 0.5 + 0.25 * np.sin(spoke * 31) + 0.25 * np.sin(spoke * 53 + 1.7)
        iris = fe.mix(AMBER, AMBER * [0.75, 0.45, 0.6], fe.smoothstep(PUPIL, RIM, polar) * (0.4 + 0.6 * streak))
        black = np.maximum(1 - fe.smoothstep(PUPIL - 0.02, PUPIL + 0.03, polar), fe.smoothstep(RIM - 0.05, RIM, polar))
        albedo = fe.mix(iris, np.full(3, 0.012), black)
        count = len(points)
        normals = vertex_normals(points, faces)
        surfaces.append(Surface(points, faces, normals, albedo, np.full(count, 0.05), np.full(count, 0.22)))
    return surfaces


def _tube_surface(path, radius, albedo_of, *, f0=0.045, roughness=0.28, flatten=1.0, bump=None, head_frame=False) -> Surface:
    """Build a swept part; `albedo_of` and `bump` are functions of (along, around)."""
    points, faces, along, around = tube(path, radius, flatten=flatten)
    if bump is not None:
        points = points + bump(along, around)[:, None] * vertex_normals(points, faces)
    points = from_head(points) if head_frame else points
    n = len(points)
    normals = vertex_normals(points, faces)
    return Surface(points, faces, normals, albedo_of(along, around), np.full(n, f0), np.full(n, roughness))


def beak_and_feet() -> list[Surface]:
    """Build the hooked beak, three toes on each foot, and the claws over the edge of the stump."""

    def beak_albedo(along, around):
        return fe.mix(fe.mix(HORN * 0.8, HORN, 0.5 + 0.5 * np.cos(around)), DARK, fe.smoothstep(0.45, 0.85, along))

    t = np.linspace(0, 1, 60)
    beak = bezier(np.array([[0, 5.6, 3.6], [0, 5.3, 5.7], [0, 4.2, 6.1], [0, 2.6, 5.2]]), 60)
    parts = [
        _tube_surface(
            beak, 0.95 * np.clip(1 - t**1.7, 1e-4, None) ** 0.75, beak_albedo, roughness=0.24, flatten=0.72, head_frame=True
        )
    ]
    for side in (-1, 1):
        for spread in (-1, 0, 1):
            end = np.array([side * 2.0 + spread * 1.25, -7.2, 5.0 - 0.25 * spread**2 - 0.12 * abs(side * 2 + spread * 1.25)])
            start = np.array([side * 2.0 + spread * 0.25, -6.5, 2.2])
            path = bezier(np.array([start, [*(0.5 * (start + end)[:1]), -6.0, 3.9], end]), 60)
            radius = 0.50 - 0.06 * t

            def scutes(along, around):
                top = np.clip(np.cos(around), 0, 1)
                return 0.07 * top * np.abs(np.sin(np.pi * along * 9))

            def toe_albedo(along, around):
                groove = 1 - np.abs(np.sin(np.pi * along * 9))
                return fe.mix(SKIN, SKIN * 0.45, np.clip(np.cos(around), 0, 1) * groove**3)

            radius[-8:] *= np.sqrt(np.linspace(1, 0.05, 8))
            parts.append(_tube_surface(path, radius, toe_albedo, roughness=0.42, bump=scutes))
            way = (end - start) * [1, 0, 1] / np.linalg.norm((end - start) * [1, 0, 1])
            claw = bezier(
                np.array([end - 0.25 * way + [0, 0.18, 0], end + 0.55 * way + [0, 0.42, 0], end + 0.62 * way - [0, 1.0, 0]]), 40
            )
            claw_radius = 0.30 * np.sqrt(np.linspace(1, 1e-4, 40))
            parts.append(_tube_surface(claw, claw_radius, lambda a, b: np.tile(DARK * 0.6, (len(a), 1)), roughness=0.24))
    return parts


def stump_distance(p: np.ndarray) -> np.ndarray:
    """Return the distance to a slightly flared tree stump with rounded edges."""
    low = fe.smoothstep(-8.2, -10.2, p[..., 1])
    radial = np.linalg.norm(p[..., [0, 2]] * [0.98, 1.0], axis=-1) - 4.75 - 0.35 * low
    q = np.stack([radial, np.abs(p[..., 1] + 9.0) - 1.55], axis=-1)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - 0.25


def stump_surface(detail: float) -> Surface:
    """Build the stump: furrowed bark, pale rings on top, moss."""
    points, faces = mesh_of(stump_distance, [-6, -11.4, -6], [6, -6.6, 6], detail, step=0.02)
    normal = gradient(stump_distance, points, step=0.05)
    angle = np.arctan2(points[:, 0], points[:, 2])
    bark = fe.smoothstep(0.75, 0.45, normal[:, 1])
    warp = points * [1, 0.28, 1]
    furrow = np.abs(fe.noise(warp, 1.5, seed=11)) + 0.35 * np.abs(fe.noise(warp, 0.6, seed=12))
    furrow = fe.smoothstep(0.0, 1.0, furrow) + 0.10 * fe.noise(points * [1, 0.5, 1], 0.45, seed=16)
    radius = np.linalg.norm(points[:, [0, 2]], axis=1) + 0.08 * np.sin(3 * angle) + 0.06 * fe.noise(points, 2.5, seed=13)
    rings = 0.5 + 0.5 * np.sin(radius * 13)
    moss = fe.smoothstep(0.25, 0.75, fe.noise(points, 3.2, seed=14) * 0.6 + 1.1 * normal[:, 1] + 0.35 * (points[:, 1] + 8.2))
    moss *= fe.smoothstep(3.9, 4.7, radius)
    tuft = fe.noise(points, 0.32, seed=15)
    lift = fe.mix(0.03 * rings, 0.42 * (furrow - 0.6), bark) * (1 - 0.6 * moss) + moss * (0.16 + 0.06 * tuft)
    albedo = fe.mix(fe.mix(WOOD, WOOD * 0.55, rings**2), fe.mix(BARK * 0.4, BARK * 1.25, furrow), bark)
    albedo = fe.mix(albedo, MOSS * (1 + 0.22 * tuft[:, None]), moss)
    points = points + lift[:, None] * normal
    n = len(points)
    return Surface(points, faces, vertex_normals(points, faces), albedo, np.full(n, 0.04), 0.75 + 0.1 * moss)


def build(*, detail: float = 0.03) -> dict[str, Surface]:
    """Build all parts in the camera frame, in metres; `detail` is the mesh edge in centimetres."""
    parts = {"plumage": plumage_surface(detail), "stump": stump_surface(2 * detail)}
    parts |= {f"eye_{i}": s for i, s in enumerate(eye_surfaces())}
    parts |= {f"part_{i}": s for i, s in enumerate(beak_and_feet())}
    return {
        name: s._replace(
            points=(s.points @ CAMERA_FROM_OWL.T - CENTER) * METRES,
            normals=s.normals @ CAMERA_FROM_OWL.T,
            albedo=np.clip(s.albedo, 0, 0.95),
        )
        for name, s in parts.items()
    }
