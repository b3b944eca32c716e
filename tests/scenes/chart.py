"""A colour chart in perspective before a background, as a camera of known colours sees it: the pixels, and where the patches are."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from tests.scenes.captures import write_lit

PITCH, PATCH = 47.0, 40.0
"""Millimetres from patch to patch, and the side of one, of the printed chart of 24."""
PASSPORT_PATCH = 0.71
"""The side of a patch of a ColorChecker Passport over their spacing: 100 / 141 in the template of colour-checker-detection 0.2.3."""

WHITE_D50 = np.array([0.96422, 1.0, 0.82521])
D65_FROM_D50 = np.array([[0.9555766, -0.0230393, 0.0631636], [-0.0282895, 1.0099416, 0.0210077], [0.0122982, -0.0204830, 1.3299098]])
REC709_FROM_XYZ = np.array([[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]])
"""Bradford's adaptation and Rec.709 as Lindbloom publishes them, seven digits."""
CAMERA = np.array([[0.62, 0.30, 0.08], [0.22, 0.68, 0.10], [0.06, 0.24, 0.70]])
"""What red, green and blue of a camera see of red, green and blue of Rec.709."""
TABLES = Path(__file__).parents[2] / "service" / "calibrate" / "solvers"


class Pose(NamedTuple):
    """How the chart stands before the camera: turned about its axes and moved, degrees and millimetres."""

    tilt: float = 0.0
    """About the horizontal axis."""
    pan: float = 0.0
    """About the vertical axis."""
    roll: float = 0.0
    """About the axis of view."""
    x: float = 0.0
    y: float = 0.0
    distance: float = 700.0


class Picture(NamedTuple):
    """The picture of a chart, and the truth about it."""

    pixels: np.ndarray  # [rows, cols, 3] float64, linear
    corners: np.ndarray  # [4, 2] pixels of the centres of the first patch, the last of the first row, the last, the first of the last row


def table(patches: int = 24) -> list[dict[str, str]]:
    """The rows of the published colours of a chart."""
    with open(TABLES / f"color_checker_{'24' if patches == 24 else 'sg'}.csv") as file:
        return list(csv.DictReader(file))


def reflectances(patches: int = 24) -> np.ndarray:
    """The published colours of a chart as linear Rec.709 [patches, 3], under its white."""
    lightness, a, b = np.array([[float(row[name]) for name in "lab"] for row in table(patches)]).T
    root = (lightness + 16) / 116 + np.stack([a / 500, 0 * a, -b / 200])
    xyz = np.where(root > 6 / 29, root**3, 3 * (6 / 29) ** 2 * (root - 4 / 29)).T * WHITE_D50
    return xyz @ D65_FROM_D50.T @ REC709_FROM_XYZ.T


class Rectangle(NamedTuple):
    """A patch beside the chart, in spacings of the chart from the centre of its first patch."""

    x: float
    y: float
    width: float
    height: float
    colour: np.ndarray


def other_page() -> list[Rectangle]:
    """The page of an open Passport above its 24 patches: eight hues, tints of grey in two rows of five, and eight greys, on a dark card."""
    turn = 2 * np.pi * np.arange(8)[:, None] / 8
    hues = 0.4 + 0.35 * np.cos(turn - np.array([0, 2.1, 4.2]))
    tints = 0.6 + 0.05 * np.linspace(-1, 1, 10)[:, None] * np.array([1, 0, -1])
    greys = np.repeat(np.array([0.03, 0.036, 0.045, 0.055, 0.46, 0.58, 0.73, 0.9])[:, None], 3, axis=1)
    rows = ((hues, 0.0, 8), (tints[:5], 0.78, 5), (tints[5:], 1.76, 5), (greys, 2.54, 8))
    patches = [Rectangle(-0.1 + (column + 0.5) * 5.2 / count, y - 3.4, 0.8 * 5.2 / count, 0.56, colour)
               for colours, y, count in rows for column, colour in enumerate(colours)]
    return [Rectangle(2.5, -2.13, 6.24, 3.3, np.full(3, 0.035)), *patches]


def poses(count: int) -> list[Pose]:
    """Poses of a chart that is tilted by up to 40 degrees in every direction, turned, moved and nearer or farther."""
    random = np.random.default_rng(1)
    towards, by = 2 * np.pi * np.arange(count) * 0.618, np.linspace(8, 40, count)
    return [Pose(tilt * np.cos(turn), tilt * np.sin(turn), *random.uniform(-25, 25, 3), random.uniform(480, 800))
            for turn, tilt in zip(towards, by, strict=True)]


def shoot(folder: Path, images: list[np.ndarray], lights: list[dict] | None = None, **manifest) -> Path:
    """A capture of images [rows, cols, 3], each under a distant light from the camera, or one of these."""
    light = {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}
    rows, cols = images[0].shape[:2]
    camera = {"projection": "orthographic", "resolution": [cols, rows]}
    return write_lit(folder, images, lights or [light] * len(images), names="{}.exr", **{
        "name": "chart", "color_space": "lin_rec709_scene", "camera": camera, **manifest})


def homography(pose: Pose, size: tuple[int, int], grid: tuple[int, int], pitch: float = PITCH) -> np.ndarray:
    """Pixels (u, v, 1), the centre of the first being 0.5, of places (column, row, 1) on the chart, up to a factor."""
    tilt, pan, roll = np.radians(pose[:3])
    about_x = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    about_y = np.array([[np.cos(pan), 0, np.sin(pan)], [0, 1, 0], [-np.sin(pan), 0, np.cos(pan)]])
    about_z = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    rotation = about_z @ about_y @ about_x
    centre = (np.array(grid) - 1) / 2
    from_grid = np.array([[pitch, 0, -pitch * centre[0]], [0, pitch, -pitch * centre[1]], [0, 0, 1]])
    place = np.column_stack([rotation[:, 0], rotation[:, 1], [pose.x, pose.y, pose.distance]])
    focal = 1.2 * size[0]
    return np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]]) @ place @ from_grid


def picture(colours: np.ndarray, pose: Pose, *, size: tuple[int, int] = (640, 480), grid: tuple[int, int] = (6, 4), pitch: float = PITCH,
            patch: float = PATCH, border: float = 0.035, samples: int = 2, seed: int = 0, beside: Sequence[Rectangle] = ()) -> Picture:
    """Return the picture of a chart whose patches reflect `colours` [patches, 3], without noise, each pixel the mean of samples²."""
    width, height = size
    form = homography(pose, size, grid, pitch)
    step = (np.arange(samples) + 0.5) / samples
    u, v = np.meshgrid((np.arange(width)[:, None] + step).ravel(), (np.arange(height)[:, None] + step).ravel())
    x, y, w = np.linalg.inv(form) @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    x, y = x / w, y / w
    column, row = np.rint(x), np.rint(y)
    reach = patch / pitch / 2
    on_patch = (np.abs(x - column) < reach) & (np.abs(y - row) < reach) & (column >= 0) & (column < grid[0]) & (row >= 0) & (row < grid[1])
    margin = 0.5 + 0.12
    on_card = (x > -margin) & (x < grid[0] - 1 + margin) & (y > -margin) & (y < grid[1] - 1 + margin)
    random = np.random.default_rng(seed)
    texture = cv2.resize(random.uniform(0.05, 0.6, (13, 17, 3)), (width * samples, height * samples), interpolation=cv2.INTER_CUBIC)
    seen = np.clip(texture, 0.02, 1).reshape(-1, 3)
    for each in beside:
        seen[(np.abs(x - each.x) < each.width / 2) & (np.abs(y - each.y) < each.height / 2)] = each.colour
    seen[on_card] = border
    index = (np.clip(row, 0, grid[1] - 1) * grid[0] + np.clip(column, 0, grid[0] - 1)).astype(int)
    seen[on_patch] = colours[index[on_patch]]
    pixels = seen.reshape(height, samples, width, samples, 3).mean(axis=(1, 3))
    last = np.array([[0, 0, 1], [grid[0] - 1, 0, 1], [grid[0] - 1, grid[1] - 1, 1], [0, grid[1] - 1, 1]], dtype=float)
    ends = form @ last.T
    return Picture(pixels, (ends[:2] / ends[2]).T)
