"""Laser stripes on textured surfaces, and frames in which a second plane of light lies beside the declared one.

A ray caster of its own: a tilted back wall, a cylinder and a board, whose albedo is printed on them; the laser stands beside the camera,
its light is stopped by what stands in the way, and a pixel is the mean of 4 × 2 rays. Pixels whose rays meet two surfaces have no truth.
"""

import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import shift

from benchmarks.trials.trial import Trial
from service.depth.depth import depth
from service.requests.depth import DepthRequest
from stage.errors import ManifestError
from stage.formats import exr

ROWS, COLS, ACROSS, DOWN, FOCAL_PX = 96, 160, 4, 2, 420.0
LASER = np.array([0.35, 0.03, 0.02])
BEAM_RAD = 2.2e-3
"""Standard deviation of the beam's angle about its plane."""
NOISE = 0.004
"""Standard deviation of a reading; a white surface in the middle of the stripe reads about 0.5."""
Texture = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Case:
    """One way to sweep the scene."""

    name: str
    texture: Texture
    planes: int = 150
    in_model: bool = True
    second: float = 0.0
    """Strength of a second, undeclared plane beside the first."""
    second_rad: float = 0.06
    """Angle between the two planes."""
    second_every: int = 1
    """The second plane is on in every so many frames."""
    late: int = 0
    """Frames by which the declared planes are late."""
    backwards: bool = False
    """The planes are declared in reverse order."""
    turned_rad: float = 0.0
    """Angle by which they are turned."""
    accuracy_deg: float | None = None
    drift_px: float = 0.0
    """By how much the camera drifts during the sweep."""
    slipped: tuple[int, int] = (0, 0)
    """Frames from the first of which on, and before the second, each shows the plane of the frame before."""


def grey(points: np.ndarray) -> np.ndarray:
    """Return an even albedo."""
    return np.full(points.shape[:-1], 0.5)


def board(points: np.ndarray) -> np.ndarray:
    """Return a chessboard of 9 mm fields, nearly black and nearly white."""
    return np.where((np.floor(points[..., 0] / 0.009) + np.floor(points[..., 1] / 0.009)) % 2 > 0, 0.75, 0.12)


def cloth(points: np.ndarray) -> np.ndarray:
    """Return smooth waves of several directions and lengths."""
    x, y, z = np.moveaxis(points, -1, 0)
    return 0.42 + 0.16 * np.sin(620 * x + 150 * y) + 0.12 * np.sin(230 * x - 410 * y + 2) + 0.1 * np.sin(900 * y + 300 * z)


def grain(points: np.ndarray) -> np.ndarray:
    """Return random fields of 2 mm."""
    cell = np.floor(points / 0.002).astype(np.int64)
    mixed = (cell[..., 0] * 73856093 ^ cell[..., 1] * 19349663 ^ cell[..., 2] * 83492791) & 0xFFFF
    return 0.1 + 0.7 * ((mixed * 40503) & 0xFFFF) / 65535


CASES = (
    Case("stripes, even albedo", grey),
    Case("stripes on a chessboard", board),
    Case("stripes on cloth", cloth),
    Case("stripes on grain", grain),
    Case("stripes far apart on cloth", cloth, planes=14),
    Case("stripes far apart on grain", grain, planes=14),
    Case("a second plane as bright", grey, planes=24, in_model=False, second=0.9),
    Case("a second plane, brighter, on a chessboard", board, planes=24, in_model=False, second=1.4, second_rad=-0.09),
    Case("a second plane in every eighth frame", cloth, planes=60, in_model=False, second=0.7, second_every=8),
    Case("a faint second plane in every fifth frame", grain, planes=60, in_model=False, second=0.2, second_every=5),
    Case("planes declared one frame late", cloth, planes=60, in_model=False, late=1),
    Case("one frame taken twice, the later ones late", cloth, planes=60, in_model=False, slipped=(25, 60)),
    Case("one frame taken twice in place of the next", cloth, planes=60, in_model=False, slipped=(25, 26)),
    Case("planes declared in reverse order", cloth, planes=60, in_model=False, backwards=True),
    Case("planes declared 1° aside", grain, planes=60, in_model=False, turned_rad=float(np.radians(1))),
    Case("planes declared 1° aside, accuracy_deg 1", grain, planes=60, turned_rad=float(np.radians(1)), accuracy_deg=1.0),
    Case("the camera drifts by 2 px on cloth", cloth, planes=60, in_model=False, drift_px=2.0),
    Case("the camera drifts by 2 px on grain", grain, planes=60, in_model=False, drift_px=2.0),
    Case("a second plane of a half on grain", grain, planes=40, in_model=False, second=0.5, second_rad=0.03),
)


def hits(origin: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far along each ray the scene lies, and its unit normal."""
    wall = np.array([0.25, 0.05, 1.0]) / np.linalg.norm([0.25, 0.05, 1.0])
    far = ((np.array([0, 0, -1.15]) - origin) @ wall) / (ray @ wall)
    normal = np.broadcast_to(wall, ray.shape)
    axis, radius = np.array([-0.06, 0, -0.95]), 0.09
    flat, from_axis = ray * [1, 0, 1], (origin - axis) * np.array([1, 0, 1])
    a, b, c = (flat**2).sum(-1), (flat * from_axis).sum(-1), (from_axis**2).sum(-1) - radius**2
    root = b * b - a * c
    near = (-b - np.sqrt(np.maximum(root, 0))) / a
    nearer = (root > 0) & (near > 1e-4) & (near < far)
    out = (from_axis + near[..., None] * flat) / radius
    far, normal = np.where(nearer, near, far), np.where(nearer[..., None], out, normal)
    board_normal = np.array([-0.3, 0.2, 1.0]) / np.linalg.norm([-0.3, 0.2, 1.0])
    there = ((np.array([0.11, 0, -0.9]) - origin) @ board_normal) / (ray @ board_normal)
    place = origin + there[..., None] * ray
    nearer = (there > 1e-4) & (there < far) & (np.abs(place[..., 0] - 0.11) < 0.045) & (np.abs(place[..., 1]) < 0.06)
    return np.where(nearer, there, far), np.where(nearer[..., None], board_normal, normal)


def rays(across: int, down: int) -> np.ndarray:
    """Return rays (x, y, -1) through each pixel, [rows · down, cols · across, 3]."""
    v, u = np.mgrid[0:ROWS * down, 0:COLS * across] + 0.5
    return np.stack([(u / across - COLS / 2) / FOCAL_PX, (ROWS / 2 - v / down) / FOCAL_PX, -np.ones_like(u)], axis=-1)


def plane_normal(angle: float) -> np.ndarray:
    """Return the unit normal of the plane through the laser whose trace turns by this angle, with the vertical slightly inclined."""
    towards = np.array([np.sin(angle), 0, -np.cos(angle)])
    normal = np.cross(towards, [0.06, 1.0, 0.0])
    return np.asarray(normal / np.linalg.norm(normal))


def swept(case: Case, seed: int = 5) -> Trial:
    """Sweep the scene, solve it with `relit depth`, and compare depths."""
    random = np.random.default_rng(seed)
    ray = rays(ACROSS, DOWN)
    far, normal = hits(np.zeros(3), ray)
    points = far[..., None] * ray
    away = points - LASER
    distance = np.linalg.norm(away, axis=-1)
    lit = hits(LASER, away)[0] > 1 - 2e-3
    cosine = np.maximum(-(away * normal).sum(axis=-1) / distance, 0) * lit
    albedo = case.texture(points)
    first, last = -0.52, -0.14
    inside = far.reshape(ROWS, DOWN, COLS, ACROSS).transpose(0, 2, 1, 3).reshape(ROWS, COLS, -1)
    whole = np.ptp(inside, axis=-1) < 0.02
    with tempfile.TemporaryDirectory() as name:
        folder, frames = Path(name), []
        angles = [*np.linspace(first, last, case.planes), None]
        for index, angle in enumerate(angles):
            image = 0.03 * albedo
            shown = angles[index - 1] if case.slipped[0] <= index < case.slipped[1] else angle
            for turn, strength in ((0.0, 1.0), (case.second_rad, case.second if index % case.second_every == 0 else 0.0)):
                if shown is not None and strength > 0:
                    off = (away @ plane_normal(shown + turn)) / distance / BEAM_RAD
                    image = image + 0.6 * strength * albedo * cosine * np.exp(-0.5 * off**2)
            pixel = image.reshape(ROWS, DOWN, COLS, ACROSS).mean(axis=(1, 3))
            if case.drift_px:
                pixel = shift(pixel, (0, case.drift_px * index / case.planes), order=1, mode="nearest")
            pixel = pixel + random.normal(0, NOISE, (ROWS, COLS))
            values = np.maximum(pixel + 0.05, 0).astype(np.float32)  # 0.05: a pedestal, so that noise is not cut
            exr.write(folder / f"{index:03d}.exr", dict.fromkeys("RGB", values), color_space="lin_rec709_scene", metadata={})
            light = {"light": {"type": "off"}}
            if angle is not None:
                declared = (first + last - angle if case.backwards else angle) + case.turned_rad
                declared += case.late * (last - first) / (case.planes - 1)
                light = {"laser": {"type": "plane", "point_m": LASER.tolist(), "normal": plane_normal(declared).tolist()}}
            if angle is not None and case.accuracy_deg is not None:
                light["laser"]["accuracy_deg"] = case.accuracy_deg
            frames.append({"image": f"{index:03d}.exr", **light})
        camera = {"projection": "perspective", "resolution": [COLS, ROWS], "focal_px": [FOCAL_PX, FOCAL_PX]}
        (folder / "capture.json").write_text(json.dumps({"schema": "relit.capture/1", "name": "sweep", "camera": camera, "frames": frames}))
        try:
            result = depth(DepthRequest(capture=folder, out=folder / "out", device="cpu"))
        except ManifestError as refused:
            nothing = np.zeros(int(whole.sum()))
            return Trial(case.name, case.in_model, nothing, nothing, nothing, nothing > 0, "mm", str(refused).split(": ", 1)[1])
    maps = result.maps
    assert maps.sigma is not None and maps.confidence is not None
    truth = hits(np.zeros(3), rays(1, 1))[0]
    return Trial(case.name, case.in_model, 1000 * np.abs(maps.depth - truth)[whole], 1000 * maps.sigma[whole],
                 maps.confidence[whole].astype(np.float64), maps.mask[whole], "mm", " ".join(result.warnings))


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield every case."""
    for case in CASES:
        yield swept(case)
