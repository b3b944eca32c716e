"""Normals that no surface has lose confidence; those of a surface do not."""

import numpy as np

from service.solve.height.integrability import doubt, misfit
from stage.capture.camera import Camera

SIDE = 64


def ball() -> tuple[np.ndarray, np.ndarray, np.ndarray, Camera]:
    """[rows, cols, 3] normals and [rows, cols] height of a cap of 50°, its mask and camera."""
    camera = Camera(projection="orthographic", resolution=(SIDE, SIDE))
    x, y = camera.plane_coordinates()
    radius = SIDE / 2 / np.sin(np.radians(50.0))
    z = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0))
    return np.stack([x, y, z], axis=-1) / radius, z, x**2 + y**2 < (SIDE / 2 - 2) ** 2, camera


def test_a_surface_has_no_misfit():
    """Normals and height of a ball; a tenth of a degree: central differences on a curve of 40 pixels radius."""
    normal, height, mask, camera = ball()
    assert misfit(normal, height, mask, camera)[mask].max() < 0.1
    np.testing.assert_allclose(doubt(np.full(mask.shape, 1.0), normal, height, mask, camera)[mask], 1)


def test_normals_of_no_surface_lose_confidence():
    """Normals turned about the view axis by 8° around the ball's middle, which is a curl that no height has."""
    normal, height, mask, camera = ball()
    turn = np.radians(8.0)
    spun = np.stack([normal[..., 0] * np.cos(turn) - normal[..., 1] * np.sin(turn),
                     normal[..., 0] * np.sin(turn) + normal[..., 1] * np.cos(turn), normal[..., 2]], axis=-1)
    factor = doubt(np.full(mask.shape, 1.0), spun, height, mask, camera)
    rim = mask & (normal[..., 2] < 0.75)
    assert np.median(misfit(spun, height, mask, camera)[rim]) > 5
    assert np.median(factor[rim]) < 0.4


def test_the_size_of_bands_changes_nothing(monkeypatch):
    normal, height, mask, camera = ball()
    spoiled = normal + np.random.default_rng(0).normal(0, 0.1, normal.shape)
    whole = misfit(spoiled, height, mask, camera)
    monkeypatch.setattr("service.solve.height.integrability.BAND_PIXELS", 5 * SIDE)
    np.testing.assert_array_equal(misfit(spoiled, height, mask, camera), whole)
