"""A courtyard with statues in closed form: what a camera sees of it, and how far points lie from it, both exact to rounding.

A kernel casts the ray of every pixel against the bodies whose outline can reach the square of pixels around it: 5 megapixels take about a
second of one core.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from stage.capture.camera import Camera

LENGTH, WIDTH, HEIGHT = 24.0, 16.0, 7.0
STATUES = 10
SQUARE = 32
"""Side in pixels of the squares that have a list of bodies each."""
NEAREST = 1e-6
"""Depth, metres, from which on a surface is before the camera."""
NEVER = 1e30
"""Depth of a ray that meets nothing, metres."""


class Scene(NamedTuple):
    """Bodies in a box that is open above; y is up, the floor is y = 0."""

    balls: np.ndarray  # [n, 4] centre and radius
    columns: np.ndarray  # [n, 3] x, z, radius; from the floor to the top
    blocks: np.ndarray  # [n, 6] lowest and highest corner
    statues: np.ndarray  # [STATUES, 3] middle

    def boxes(self) -> np.ndarray:
        """Return the lowest and highest corner of every body, [n, 2, 3]: balls, columns, blocks."""
        ball = np.stack([self.balls[:, :3] - self.balls[:, 3:], self.balls[:, :3] + self.balls[:, 3:]], axis=1)
        x, z, radius = self.columns.T
        low, high = np.stack([x - radius, 0 * x, z - radius], axis=1), np.stack([x + radius, 0 * x + HEIGHT, z + radius], axis=1)
        column = np.stack([low, high], axis=1)
        return np.concatenate([ball, column, self.blocks.reshape(-1, 2, 3)])


def make_scene() -> Scene:
    """Return the courtyard, always the same."""
    rng = np.random.default_rng(18)
    balls, blocks, statues = [], [], []
    for number in range(STATUES):
        x = (number % 5 - 2) * 4.0 + rng.uniform(-0.5, 0.5)
        z = (3.2 if number < 5 else -3.2) + rng.uniform(-0.5, 0.5)
        half = rng.uniform(0.35, 0.5, 2)
        top = rng.uniform(0.7, 1.0)
        blocks.append([x - half[0], 0, z - half[1], x + half[0], top, z + half[1]])
        statues.append([x, top + 0.45, z])
        for _ in range(26):
            radius = rng.uniform(0.04, 0.2)
            spread = rng.normal(scale=[0.16, 0.28, 0.16])
            balls.append([x + spread[0], top + 0.4 + spread[1], z + spread[2], radius])
    for _ in range(220):  # bosses on the walls and on the floor
        wall, radius = rng.integers(5), rng.uniform(0.1, 0.5)
        place = rng.uniform([-LENGTH / 2, 0.3, -WIDTH / 2], [LENGTH / 2, HEIGHT - 1, WIDTH / 2])
        axis, side = [(0, -LENGTH / 2), (0, LENGTH / 2), (2, -WIDTH / 2), (2, WIDTH / 2), (1, 0.0)][wall]
        place[axis] = side - np.sign(side) * radius * rng.uniform(-0.4, 0.4) if axis != 1 else -radius * rng.uniform(0.2, 0.7)
        balls.append([*place, radius])
    for _ in range(18):
        middle, half = rng.uniform([-11, 0, -7.5], [11, 0, 7.5]), rng.uniform([0.1, 0.1, 0.1], [0.6, 0.5, 0.6])
        blocks.append([*(middle - half * [1, 0, 1]), *(middle + half * [1, 2, 1])])
    columns = [[x, z, rng.uniform(0.2, 0.35)] for z in (-6.0, 6.0) for x in rng.uniform(-0.4, 0.4, 7) + np.linspace(-10, 10, 7)]
    return Scene(np.array(balls), np.array(columns), np.array(blocks), np.array(statues))


def distance(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Return the distance of points [n, 3] from the nearest surface, metres."""
    x, y, z = points.T
    best = np.minimum.reduce([np.abs(y), np.abs(LENGTH / 2 - np.abs(x)), np.abs(WIDTH / 2 - np.abs(z))])
    for ball in scene.balls:
        best = np.minimum(best, np.abs(np.linalg.norm(points - ball[:3], axis=1) - ball[3]))
    for cx, cz, radius in scene.columns:
        best = np.minimum(best, np.abs(np.hypot(x - cx, z - cz) - radius))
    for block in scene.blocks:
        q = np.abs(points - (block[:3] + block[3:]) / 2) - (block[3:] - block[:3]) / 2
        best = np.minimum(best, np.abs(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)))
    return best


@wp.func
def _nearer(best: wp.float64, found: wp.float64) -> wp.float64:
    return wp.where(found > wp.float64(NEAREST) and found < best, found, best)


@wp.func
def _wall(best: wp.float64, eye: wp.vec3d, ray: wp.vec3d, axis: int, side: wp.float64) -> wp.float64:
    if ray[axis] == wp.float64(0.0):
        return best
    at = (side - eye[axis]) / ray[axis]
    return wp.where(eye[1] + at * ray[1] < wp.float64(HEIGHT), _nearer(best, at), best)


@wp.func
def _ball(best: wp.float64, eye: wp.vec3d, ray: wp.vec3d, body: wp.array2d(dtype=wp.float64), k: int) -> wp.float64:
    away = wp.vec3d(body[k, 0], body[k, 1], body[k, 2]) - eye
    along = wp.dot(ray, away)
    square = wp.dot(ray, ray)
    root = along * along - square * (wp.dot(away, away) - body[k, 3] * body[k, 3])
    if along <= wp.float64(0.0) or root < wp.float64(0.0):
        return best
    return _nearer(best, (along - wp.sqrt(root)) / square)


@wp.func
def _column(best: wp.float64, eye: wp.vec3d, ray: wp.vec3d, body: wp.array2d(dtype=wp.float64), k: int) -> wp.float64:
    x = body[k, 0] - eye[0]
    z = body[k, 1] - eye[2]
    along = ray[0] * x + ray[2] * z
    square = ray[0] * ray[0] + ray[2] * ray[2]
    root = along * along - square * (x * x + z * z - body[k, 2] * body[k, 2])
    if along <= wp.float64(0.0) or root < wp.float64(0.0):
        return best
    at = (along - wp.sqrt(root)) / square
    return wp.where(eye[1] + at * ray[1] < wp.float64(HEIGHT), _nearer(best, at), best)


@wp.func
def _block(best: wp.float64, eye: wp.vec3d, ray: wp.vec3d, body: wp.array2d(dtype=wp.float64), k: int) -> wp.float64:
    first = wp.float64(-NEVER)
    last = wp.float64(NEVER)
    for axis in range(3):
        low = (body[k, axis] - eye[axis]) / ray[axis]
        high = (body[k, 3 + axis] - eye[axis]) / ray[axis]
        first = wp.max(first, wp.min(low, high))
        last = wp.min(last, wp.max(low, high))
    return wp.where(first > wp.float64(0.0) and first <= last, _nearer(best, first), best)


@wp.kernel(enable_backward=False)
def _look_kernel(first: int, eye: wp.vec3d, turn: wp.mat33d, focal: wp.float64, cols: int, rows: int, balls: int, columns: int,
                 squares: int, start: wp.array(dtype=int), listed: wp.array(dtype=int), body: wp.array2d(dtype=wp.float64),
                 # outputs
                 depth: wp.array(dtype=wp.float64)):
    i = first + wp.tid()
    row = i // cols
    col = i - row * cols
    x = (wp.float64(col) + wp.float64(0.5) - wp.float64(cols) / wp.float64(2.0)) / focal
    y = (wp.float64(rows) / wp.float64(2.0) - wp.float64(row) - wp.float64(0.5)) / focal
    ray = turn * wp.vec3d(x, y, wp.float64(-1.0))
    best = wp.float64(NEVER)
    if ray[1] < wp.float64(0.0):
        best = _nearer(best, -eye[1] / ray[1])
    best = _wall(best, eye, ray, 0, wp.float64(-LENGTH / 2.0))
    best = _wall(best, eye, ray, 0, wp.float64(LENGTH / 2.0))
    best = _wall(best, eye, ray, 2, wp.float64(-WIDTH / 2.0))
    best = _wall(best, eye, ray, 2, wp.float64(WIDTH / 2.0))
    square = (row // SQUARE) * squares + col // SQUARE
    for place in range(start[square], start[square + 1]):
        k = listed[place]
        if k < balls:
            best = _ball(best, eye, ray, body, k)
        elif k < balls + columns:
            best = _column(best, eye, ray, body, k)
        else:
            best = _block(best, eye, ray, body, k)
    depth[i] = wp.where(best < wp.float64(NEVER), best, wp.float64(0.0))


def look(scene: Scene, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Return the z-depth of each pixel of a camera with square pixels, [rows, cols] float64 metres; 0 where the ray leaves by the top."""
    assert camera.focal_px is not None
    start, listed = _lists(scene, camera, pose)
    body = np.zeros((len(scene.balls) + len(scene.columns) + len(scene.blocks), 6))
    body[:len(scene.balls), :4] = scene.balls
    body[len(scene.balls):len(scene.balls) + len(scene.columns), :3] = scene.columns
    body[len(body) - len(scene.blocks):] = scene.blocks
    arrays: list[Any] = [wp.array(start, dtype=int, device="cpu"), wp.array(listed, dtype=int, device="cpu"),
                         wp.array(body, dtype=wp.float64, device="cpu")]
    depth = wp.empty(camera.width * camera.height, dtype=wp.float64, device="cpu")
    devices.launch(_look_kernel, camera.width * camera.height,
                   [wp.vec3d(*pose[:3, 3]), wp.mat33d(*pose[:3, :3].ravel()), wp.float64(camera.focal_px[0]), camera.width, camera.height,
                    len(scene.balls), len(scene.columns), -(-camera.width // SQUARE), *arrays], [depth], device="cpu", uneven=True)
    return np.asarray(depth.numpy().reshape(camera.height, camera.width))


def _lists(scene: Scene, camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the list of bodies of each square of pixels begins, [squares + 1], and the bodies of all lists."""
    boxes = scene.boxes()
    corners = np.stack([boxes[:, sides, (0, 1, 2)] for sides in np.ndindex(2, 2, 2)], axis=1)  # [n, 8, 3]
    own = (corners - pose[:3, 3]) @ pose[:3, :3]
    behind = (own[..., 2] >= -NEAREST).all(axis=1)
    whole = (own[..., 2] >= -NEAREST).any(axis=1)
    u, v = camera.image_coordinates(np.where(whole[:, None, None], [0.0, 0.0, -1.0], own).reshape(-1, 3))
    u, v = u.reshape(-1, 8), v.reshape(-1, 8)
    shape = -(-camera.height // SQUARE), -(-camera.width // SQUARE)
    reached = np.zeros((*shape, len(boxes)), dtype=bool)
    for k in np.flatnonzero(~behind):
        if whole[k]:
            reached[:, :, k] = True
            continue
        top, left = (max(int(values[k].min() - 1) // SQUARE, 0) for values in (v, u))
        bottom, right = (max(int(values[k].max() + 1) // SQUARE + 1, 0) for values in (v, u))
        reached[top:bottom, left:right, k] = True
    of_square = reached.reshape(-1, len(boxes))
    start = np.concatenate([[0], np.cumsum(of_square.sum(axis=1))]).astype(np.int32)
    return start, np.nonzero(of_square)[1].astype(np.int32)
