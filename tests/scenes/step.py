"""A block on a flat base under the planes of a laser: images from exact geometry in float64, with the shadow of the block."""

from pathlib import Path

import numpy as np

from tests.reference import projector as reference
from tests.scenes.captures import write_images, write_manifest
from tests.scenes.depth import entry_of
from tests.scenes.in_front import unit

CAMERA = reference.Device(480, 360, 480.0, (-0.05, 0.02, 0.0), (0.001, -0.001))
HEIGHT = 0.05
LASER = np.array((0.3, 0.08, 0.0))
WIDTH = 0.0012
"""Standard deviation of the stripe, metres: 1 px."""
PLACEHOLDER = {"type": "plane", "point_m": [0, 0, 0], "normal": [1, 0, 0]}


def laser_planes(count: int = 8, spread: float = 26.0) -> list[np.ndarray]:
    """Unit normals of planes through the laser's place, turned about an axis that leans 12° from the vertical of the camera."""
    axis = unit(np.array((0.2, 1.0, -0.05)))
    found = []
    for angle in np.radians(np.linspace(-spread / 2, spread / 2, count)):
        ahead = unit(np.array((-0.42 + np.tan(angle), -0.1, -1.0)))
        found.append(unit(np.cross(axis, ahead)))
    return found


class Step:
    """A block of a width and the base that it stands on, seen from `elevation` degrees above the base."""

    def __init__(self, *, elevation: float = 40.0, distance: float = 0.55, turn: float = 8.0, width: float = 0.12,
                 lean: float = 0.0) -> None:
        up = np.radians(elevation)
        self.normal = np.array((0.0, np.cos(up), np.sin(up)))
        self.place = np.array((0.0, 0.0, -distance))
        facing = np.array((0.0, -np.sin(up), np.cos(up)))
        side = np.cross(self.normal, facing)
        self.facing = np.cos(np.radians(turn)) * facing + np.sin(np.radians(turn)) * side
        self.width = width
        self.riser = self.facing + np.tan(np.radians(lean)) * self.normal  # of a block that is not right-angled
        """Normal of the riser."""

    def inside(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Which points lie in the block."""
        off = points - self.place
        high, ahead, front = off @ self.normal, off @ self.facing, off @ self.riser
        return np.asarray((high > -1) & (high < HEIGHT - margin) & (front < self.width / 2 - margin) & (ahead > -self.width / 2 + margin))

    def seen(self, rays: np.ndarray) -> np.ndarray:
        """[rows, cols, 3] the points that lines of sight meet first."""
        best = np.full(rays.shape[:2], np.inf)
        faces = ((self.normal, self.normal @ self.place), (self.normal, self.normal @ self.place + HEIGHT),
                 (self.riser, self.riser @ self.place + self.width / 2), (-self.facing, -self.facing @ self.place + self.width / 2))
        for number, (normal, offset) in enumerate(faces):
            with np.errstate(divide="ignore", invalid="ignore"):
                depth = offset / (rays @ normal)
            points = rays * depth[..., None]
            off = points - self.place
            high, ahead, front = off @ self.normal, off @ self.facing, off @ self.riser
            held = (np.ones(depth.shape, bool), (front <= self.width / 2) & (ahead >= -self.width / 2), (high >= 0) & (high <= HEIGHT),
                    (high >= 0) & (high <= HEIGHT))[number]
            best = np.where(held & (depth > 0) & (depth < best), depth, best)
        return rays * best[..., None]

    def shaded(self, points: np.ndarray) -> np.ndarray:
        """Which points the block keeps the laser from."""
        found = np.zeros(points.shape[:2], bool)
        for part in np.concatenate([np.linspace(0.004, 0.3, 120), np.linspace(0.3, 0.9, 30)]):
            at = points + part * (LASER - points)
            found |= self.inside(at, 1e-4) & ((at - self.place) @ self.normal > 1e-4)
        return found


def photograph(folder: Path, step: Step, planes: list[np.ndarray], *, noise: float = 0.004, seed: int = 1, even: bool = True) -> Path:
    """A capture of the stripes on the step, the planes not known, and one frame without the laser; texture of 15 %."""
    random = np.random.default_rng(seed)
    points = step.seen(reference.pixel_rays(CAMERA))
    clear = ~step.shaded(points)
    off = points - step.place
    texture = 1 + 0.15 * np.sin(90 * (off @ np.cross(step.normal, step.facing))) * np.cos(70 * (off @ step.facing + off @ step.normal))
    images, entries = [], [*([{"laser": PLACEHOLDER}] * len(planes)), *([{"light": {"type": "off"}}] if even else [])]
    for normal in [*planes, None] if even else planes:
        glow = 0.0 if normal is None else 0.7 * clear * np.exp(-(((points - LASER) @ normal) ** 2) / (2 * WIDTH**2))
        images.append(np.maximum(0.6 * texture * (0.1 + glow) + random.normal(0, noise, points.shape[:2]), 0))
    write_manifest(folder, {"schema": "relit.capture/1", "name": "step", "camera": {"projection": "perspective", **entry_of(CAMERA)},
                            "frames": write_images(folder, images, entries, "{}.exr")})
    return folder
