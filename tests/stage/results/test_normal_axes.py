"""Normals of maps.exr that another program has changed: named where their length or the height contradicts them, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from stage.capture.camera import Camera
from stage.errors import ResultError
from stage.results.maps import SurfaceMaps
from tests.scenes.surfaces import make_ball

BALL = make_ball(48)
QUARTER = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""The axes of a world whose camera looks along another of them."""


def read(folder, maps, normal):
    replace(maps, normal=normal.astype(np.float32)).write(folder / "maps.exr")
    return SurfaceMaps.read(folder / "maps.exr")


@pytest.mark.parametrize(("change", "words"), [
    (lambda n: 0.5 + 0.5 * n, "not 1, as where they are stored as 0…1"), (lambda n: n * [1, -1, 1], r"read as \(X, -Y, Z\)"),
    (lambda n: n[..., ::-1], r"read as \(Z, Y, X\)"), (lambda n: n @ QUARTER.T, r"read as \(Y, Z, X\)")])
def test_normals_of_another_convention_are_refused(tmp_path, change, words):
    with pytest.raises(ResultError, match=words):
        read(tmp_path, BALL, change(BALL.normal))


def test_a_height_whose_sign_is_the_other_is_refused(tmp_path):
    with pytest.raises(ResultError, match=r"read as \(-X, -Y, Z\)"):
        read(tmp_path, make_ball(48, height=-BALL.height), BALL.normal)


@pytest.mark.parametrize("factor", [1000, 0.001, 2, 1.2])
def test_a_height_of_another_unit_is_refused(tmp_path, factor):
    """In millimetres, or twice as steep as its normals; a fifth may be their error."""
    changed = make_ball(48, height=(factor * BALL.height).astype(np.float32))
    if factor == 1.2:
        read(tmp_path, changed, BALL.normal)
        return
    with pytest.raises(ResultError, match=r"layer height is [0-9.]+ times as high as layer normal says: give it in metres"):
        read(tmp_path, changed, BALL.normal)


def test_noise_turns_and_what_the_camera_sees_from_near_leave_nothing_to_say(tmp_path):
    """Noise of 10°, lights that are 20° off, and a ball before a perspective camera, whose normals are those of its points."""
    noise = np.random.default_rng(0).normal(0, np.radians(10), BALL.normal.shape)
    unit = (BALL.normal + noise) / np.linalg.norm(BALL.normal + noise, axis=-1, keepdims=True)
    read(tmp_path, BALL, unit)
    angle = np.radians(20)
    read(tmp_path, BALL, BALL.normal @ np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]))
    camera = Camera(projection="perspective", resolution=(48, 48), focal_px=(70.0, 70.0), surface_z_m=-0.4)
    x, y = camera.plane_coordinates()
    ray = np.stack([x, y, -np.ones_like(x)], axis=-1)
    root = 0.4**2 - (1 - 0.1**2 / 0.4**2) * (ray**2).sum(axis=-1) * 0.4**2  # |t ray + (0, 0, 0.4)| = 0.1
    mask = root > 0.001
    way = (0.4 - np.sqrt(np.where(mask, root, 0))) / (ray**2).sum(axis=-1)
    normal = (way[..., None] * ray + [0, 0, 0.4]) / 0.1
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    near = SurfaceMaps(camera=camera, mask=mask, normal=normal.astype(np.float32), height=-way.astype(np.float32))
    read(tmp_path, near, normal)
    with pytest.raises(ResultError, match=r"read as \(-X, Y, Z\)"):
        read(tmp_path, near, normal * [-1, 1, 1])
    with pytest.raises(ResultError, match=r"layer height is -3.* in the median, and its camera has the surface at -0.4 m"):
        read(tmp_path, replace(near, height=1000 * near.height), normal)
