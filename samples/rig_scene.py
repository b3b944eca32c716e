"""The virtual projector-camera rig: its two devices, the objects in front of them, and Mitsuba's projector emitter.

Camera frame, metres. The camera sees: a back plane, a V-groove that lights itself, a sphere and four steps, all Lambertian.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from stage.capture.camera import Camera, Distortion
from stage.capture.projector import Projector
from stage.transforms import rotation_about, rotation_about_y

WIDTH, HEIGHT = 256, 192
CAMERA_FOCAL_PX, CAMERA_PRINCIPAL_PX = 340.0, (130.5, 94.0)
PROJECTOR_FOCAL_PX, PROJECTOR_PRINCIPAL_PX = 330.0, (122.0, 90.0)  # off centre, as the lens shift of real ones
PROJECTOR_POSITION_M = (0.299, 0.02, 0.01)  # a baseline of 0.3
CONVERGENCE_DEGREES, ROLL_DEGREES = 10.0, 1.0
EMITTER_RESOLUTION = (360, 300)
"""Mitsuba's projector has its principal point in the middle and no distortion: it shines through this larger window, centred on
the principal point, with the projector's pixels at their size; what falls outside the panel is dropped."""
IRRADIANCE = 1.0  # on a surface facing the projector at 1 m, times pi: radiance there is the albedo
AMBIENT_RADIANCE = 0.03
BACK_M = 1.45
GROOVE_LINE_M, GROOVE_FACES_M = (-0.20, -1.43), (0.15, 0.0)  # x, z of its deepest line, and of what it opens towards
GROOVE_OPENING_DEGREES, GROOVE_DEPTH_M, GROOVE_Y_M = 80.0, 0.20, (-0.33, 0.15)
SPHERE_CENTER_M, SPHERE_RADIUS_M = (0.20, 0.16, -1.22), 0.12
STEPS_M = [(0.06 + 0.075 * i, 1.34 - 0.10 * i) for i in range(4)]  # left edge, distance of the front
STEP_WIDTH_M, STEP_Y_M = 0.075, (-0.26, -0.05)
CAMERA_DISTORTION = Distortion(model="brown_conrady", k=(-0.12, 0.03, 0.0), p=(0.001, -0.0005))
PROJECTOR_DISTORTION = Distortion(model="brown_conrady", k=(0.06, 0.0, 0.0), p=(0.0, 0.001))
TEXTURE_SIZE = 512


class Rig(NamedTuple):
    """The two devices, as the manifest declares them."""

    camera: Camera
    projector: Projector


def make_rig(*, distorted: bool = False) -> Rig:
    """Return the rig, with or without lens distortion of both devices."""
    camera = Camera(
        projection="perspective",
        resolution=(WIDTH, HEIGHT),
        focal_px=(CAMERA_FOCAL_PX, CAMERA_FOCAL_PX),
        principal_px=CAMERA_PRINCIPAL_PX,
        distortion=CAMERA_DISTORTION if distorted else None,
    )
    pose = np.eye(4)
    pose[:3, :3] = rotation_about_y(CONVERGENCE_DEGREES) @ rotation_about((0.0, 0.0, 1.0), ROLL_DEGREES)
    pose[:3, 3] = PROJECTOR_POSITION_M
    projector = Projector.model_validate({
        "resolution": (WIDTH, HEIGHT),
        "focal_px": (PROJECTOR_FOCAL_PX, PROJECTOR_FOCAL_PX),
        "principal_px": PROJECTOR_PRINCIPAL_PX,
        "distortion": PROJECTOR_DISTORTION if distorted else None,
        "camera_from_projector": pose.tolist(),
    })  # fmt: skip
    return Rig(camera, projector)


def panel_at(projector: Projector, x: Any, down: Any) -> tuple[Any, Any]:
    """Return the continuous projector coordinates (u, v) of ideal image-plane coordinates X/Z right and Y/Z down, NumPy's or Dr.Jit's."""
    if projector.distortion is not None:
        x, down = projector.distortion.apply(x, down)
    (fx, fy), (cu, cv) = projector.focal_px, projector.principal_px or (0.0, 0.0)
    return fx * x + cu, fy * down + cv


def project(projector: Projector, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # [..., 3] camera frame, metres
    """Return the continuous projector coordinates (u, v) from which light reaches points; NaN behind the projector."""
    pose = np.array(projector.camera_from_projector, dtype=np.float64)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    depth = np.where(local[..., 2] < 0, -local[..., 2], np.nan)
    return panel_at(projector, local[..., 0] / depth, -local[..., 1] / depth)


def projector_ray(projector: Projector, u: float, v: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the origin and the unit direction of the light of a projector pixel, camera frame."""
    (fx, fy), (cu, cv) = projector.focal_px, projector.principal_px or (0.0, 0.0)
    x, down = np.array((u - cu) / fx), np.array((v - cv) / fy)
    if projector.distortion is not None:
        x, down = projector.distortion.undo(x, down)
    pose = np.array(projector.camera_from_projector, dtype=np.float64)
    direction = pose[:3, :3] @ np.array([float(x), -float(down), -1.0])
    return pose[:3, 3], direction / np.linalg.norm(direction)


def emitter(mi, projector: Projector, texture: np.ndarray | None = None) -> dict:
    """Return Mitsuba's projector for a pattern [HEIGHT, WIDTH] float in 0…1, or for white over the whole image.

    Patterns blend linearly from pixel centre to pixel centre, as in a projector that is slightly out of focus.
    """
    width, height = EMITTER_RESOLUTION
    window = np.ones((height, width), np.float32)
    if texture is not None:
        (cu, cv), (rows, cols) = projector.principal_px or (0.0, 0.0), texture.shape
        top, left = round(height / 2 - cv), round(width / 2 - cu)
        window[:] = 0
        window[top : top + rows, left : left + cols] = texture
    local = np.array(projector.camera_from_projector, dtype=np.float64) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    return {
        "type": "projector",
        "to_world": mi.ScalarTransform4f(local),  # Mitsuba's devices look along +z with +x to their left
        "fov": float(np.degrees(2 * np.arctan(0.5 * width / projector.focal_px[0]))),
        "fov_axis": "x",
        "irradiance": {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(np.repeat(window[..., None], 3, axis=-1))),
            "raw": True,
            "filter_type": "bilinear",
            "wrap_mode": "clamp",
        },
        "scale": IRRADIANCE,
    }


def _albedo(mi, seed: int, *, mean: float, swing: float, cycles: int = 5) -> dict:
    """Return a Lambertian material whose albedo varies slowly by mean ± swing."""
    random = np.random.default_rng(seed)
    v, u = (np.mgrid[:TEXTURE_SIZE, :TEXTURE_SIZE] + 0.5) / TEXTURE_SIZE
    waves = sum(
        np.cos(2 * np.pi * (random.integers(-cycles, cycles + 1) * u + random.integers(-cycles, cycles + 1) * v) + phase)
        for phase in random.uniform(0, 2 * np.pi, 6)
    )
    value = mean + swing * waves / np.abs(waves).max()
    bitmap = mi.Bitmap(np.repeat(value[..., None], 3, axis=-1).astype(np.float32))
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}


def _rectangle(mi, bsdf: dict, corner, edge_u, edge_v) -> dict:
    """Return a parallelogram from one corner along two edges; its lit side is that of edge_u × edge_v."""
    corner, edge_u, edge_v = (np.asarray(x, dtype=np.float64) for x in (corner, edge_u, edge_v))
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1] = edge_u / 2, edge_v / 2
    normal = np.cross(edge_u, edge_v)
    pose[:3, 2], pose[:3, 3] = normal / np.linalg.norm(normal), corner + (edge_u + edge_v) / 2
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(pose), "bsdf": bsdf}


def shapes(mi) -> dict[str, Any]:
    """Load the objects and return them by name; the walls of the groove are `groove_left` and `groove_right`."""
    back = _rectangle(mi, _albedo(mi, 1, mean=0.6, swing=0.22), (-1.2, -0.9, -BACK_M), (2.4, 0, 0), (0, 1.8, 0))
    (x, z), (to_x, to_z), (low, high) = GROOVE_LINE_M, GROOVE_FACES_M, GROOVE_Y_M
    facing = np.arctan2(to_x - x, to_z - z)  # from +z towards +x
    half = np.radians(GROOVE_OPENING_DEGREES) / 2
    up, line = np.array([0, high - low, 0]), np.array([x, low, z])
    walls = {}
    for name, angle in (("groove_left", facing - half), ("groove_right", facing + half)):
        edge = GROOVE_DEPTH_M * np.array([np.sin(angle), 0, np.cos(angle)])
        edges = (up, edge) if name == "groove_left" else (edge, up)
        sides = _rectangle(mi, _albedo(mi, 2, mean=0.78, swing=0.05, cycles=2), line, *edges)
        walls[name] = sides
    steps = {}
    for i, (left, distance) in enumerate(STEPS_M):
        middle = (left + STEP_WIDTH_M / 2, sum(STEP_Y_M) / 2, -(distance + BACK_M) / 2)
        size = (STEP_WIDTH_M / 2, (STEP_Y_M[1] - STEP_Y_M[0]) / 2, (BACK_M - distance) / 2)
        pose = mi.ScalarTransform4f().translate(middle) @ mi.ScalarTransform4f().scale(size)
        steps[f"step_{i}"] = {"type": "cube", "to_world": pose, "bsdf": _albedo(mi, 10 + i, mean=0.55, swing=0.12, cycles=1)}
    turn = mi.ScalarTransform4f().translate(SPHERE_CENTER_M) @ mi.ScalarTransform4f().rotate([1, 0, 0], -90)  # its pole is up
    pose = turn @ mi.ScalarTransform4f().scale(SPHERE_RADIUS_M)
    ball = {"type": "sphere", "to_world": pose, "bsdf": _albedo(mi, 5, mean=0.6, swing=0.15)}
    return {name: mi.load_dict(shape) for name, shape in ({"back": back, "sphere": ball} | walls | steps).items()}
