"""Pairs of views under projected texture with a known depth: planes, spheres and rectangles traced in float64.

Every pixel is the mean over a grid of places within it, so that edges are mixed as a camera mixes them. The texture comes from a projector
of its own: what another part keeps from its light is dark. Nothing here imports the code that it judges.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.reference import projector as reference
from tests.scenes.captures import write_image, write_manifest
from tests.scenes.depth import entry_of
from tests.scenes.projected import FAR_M, Shape, meet

CAMERA = reference.Device(320, 240, 420.0, (-0.08, 0.02, 0.0), (0.0006, -0.0004))
OTHER = reference.Device(320, 240, 424.0, (-0.06, 0.01, 0.0), (-0.0005, 0.0003))
POSE = reference.look_at((0.12, 0.004, 0.003), (0.03, 0.0, -1.0))
PROJECTOR = reference.Device(512, 400, 520.0)
PROJECTOR_POSE = reference.look_at((0.05, 0.06, 0.0), (0.02, 0.0, -1.0))
SIDE = 4
"""Places within a pixel, along each side."""
AMBIENT = 0.03


class View(NamedTuple):
    """What a camera sees."""

    images: np.ndarray  # [patterns, rows, cols] float64, linear, without noise
    depth: np.ndarray  # [rows, cols] float64 metres at the centre of each pixel; NaN where nothing is
    part: np.ndarray  # [rows, cols] int, index of the part that is seen there
    points: np.ndarray  # [rows, cols, 3] float64, in the frame of the reference camera


def dots(seed: int, *, cell: int = 3, fill: float = 0.5) -> np.ndarray:
    """[rows, cols] random squares of the projector, of `cell` pixels, 0 or 1."""
    rng = np.random.default_rng(seed)
    top, left = rng.integers(0, cell, 2)
    squares = (rng.random((PROJECTOR.height // cell + 2, PROJECTOR.width // cell + 2)) < fill).astype(float)
    return np.kron(squares, np.ones((cell, cell)))[top:top + PROJECTOR.height, left:left + PROJECTOR.width]


def grid_of_dots(period: int = 8) -> np.ndarray:
    """[rows, cols] the same dot again and again."""
    rows, cols = np.indices((PROJECTOR.height, PROJECTOR.width))
    return ((rows % period < period // 2) & (cols % period < period // 2)).astype(float)


def render(parts: Sequence[Shape], textures: list[np.ndarray], camera: reference.Device = CAMERA, pose: np.ndarray | None = None, *,
           side: int = SIDE) -> View:
    """What a camera at `pose` (camera_from_other; None: the reference) sees of the parts under each texture."""
    pose = np.eye(4) if pose is None else pose
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    images = np.zeros((len(textures), camera.height, camera.width))
    for down in range(side):
        for across in range(side):
            uv = np.stack([u + (across + 0.5) / side, v + (down + 0.5) / side], axis=-1)
            images += shade(parts, textures, pose[:3, 3], unit(reference.rays(camera, uv))[0] @ pose[:3, :3].T)
    rays, length = unit(reference.rays(camera, np.stack([u + 0.5, v + 0.5], axis=-1)))
    distance, _, _, part = meet(parts, pose[:3, 3], rays @ pose[:3, :3].T)
    distance = np.where(distance < FAR_M, distance, np.nan)
    return View(images / side**2, distance / length, part, pose[:3, 3] + distance[..., None] * (rays @ pose[:3, :3].T))


def unit(ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions of ways [..., 3], and their lengths."""
    length = np.linalg.norm(ways, axis=-1)
    return ways / length[..., None], length


def shade(parts, textures, origin, rays):
    """[patterns, rows, cols] radiance along rays."""
    distance, _, albedo, _ = meet(parts, origin, rays)
    seen = distance < FAR_M
    points = origin + np.where(seen, distance, 0)[..., None] * rays
    away, far = unit(points - PROJECTOR_POSE[:3, 3])
    clear = meet(parts, PROJECTOR_POSE[:3, 3], away)[0] > (1 - 1e-6) * far
    at = reference.seen_by(PROJECTOR, PROJECTOR_POSE, points) - 0.5
    lit = seen & clear & (at >= 0).all(axis=-1) & (at[..., 0] < PROJECTOR.width - 1) & (at[..., 1] < PROJECTOR.height - 1)
    at = np.where(lit[..., None], at, 0)
    col, row = (np.floor(at[..., i]).astype(int) for i in (0, 1))
    right, down = at[..., 0] - col, at[..., 1] - row
    fall = 0.5 / far**2
    found = []
    for texture in textures:  # interpolated: a projector's pixels are as wide as they are apart, and never sharper
        shown = ((1 - down) * ((1 - right) * texture[row, col] + right * texture[row, col + 1])
                 + down * ((1 - right) * texture[row + 1, col] + right * texture[row + 1, col + 1]))
        found.append(np.where(seen, albedo * (AMBIENT + np.where(lit, fall * shown, 0)), 0))
    return np.stack(found)


def visible_to(parts, points, pose, camera=OTHER):
    """[rows, cols] bool: the camera at `pose` sees these points, and its image holds them."""
    away, far = unit(points - pose[:3, 3])
    clear = meet(parts, pose[:3, 3], away)[0] > (1 - 1e-4) * far
    uv = reference.seen_by(camera, pose, points)
    return clear & (uv > 0).all(axis=-1) & (uv[..., 0] < camera.width) & (uv[..., 1] < camera.height)


def recorded(image: np.ndarray, rng: np.random.Generator, *, gain: float = 1.0, read: float = 0.004, photons: float = 4000.0) -> np.ndarray:
    """[rows, cols] uint16 of one frame with shot and read noise; `photons` at full scale."""
    level = np.clip(gain * image, 0, None)
    noisy = level + rng.normal(size=image.shape) * np.sqrt(read**2 + level / photons)
    return np.rint(65535 * np.clip(noisy, 0, 1)).astype(np.uint16)


def write_pair(folder: Path, reference_images: list[np.ndarray], other_images: list[np.ndarray], *, camera=CAMERA, other=OTHER, pose=POSE,
               further: list[dict[str, Any]] | None = None, **changes: Any) -> Path:
    """Write a capture of recorded frames, uint16 [rows, cols]; `further` frames come after them."""
    frames = []
    for index, (left, right) in enumerate(zip(reference_images, other_images, strict=True)):
        write_image(folder / f"left_{index}.png", left)
        write_image(folder / f"right_{index}.png", right)
        frames.append({"image": f"left_{index}.png", "stereo": {"images": [f"right_{index}.png"]}})
    write_manifest(folder, {
        "schema": "relit.capture/1", "name": "pair", "camera": {"projection": "perspective", **entry_of(camera)},
        "other_cameras": [{"name": "right", **entry_of(other), "camera_from_other": np.asarray(pose).tolist()}],
        "frames": [*frames, *(further or [])], **changes})
    return folder
