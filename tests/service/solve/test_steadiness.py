"""Captures whose camera shook are told from steady ones by the texture of the object."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from tests.scenes.captures import Scene, angles_degrees, write_capture
from tests.scenes.parts import sphere_lights
from tests.scenes.translucent import waves

pytestmark = pytest.mark.long

SIDE, LIGHTS = 96, 24
SPAN = 1.6
"""Difference of the largest and the smallest component of the directions along an axis of the image."""


def solved(folder, *, shake_px=0.0, drift_px=0.0, noise=0.002, contrast=0.25, seed=3, method=Method.ROBUST):
    """What a solve says of a textured surface, each image of which is moved at random, and up by as much as its light comes from above;
    and the error of each normal over its σ."""
    rng = np.random.default_rng(seed)
    _, normal = waves(SIDE, seed)
    directions = sphere_lights(LIGHTS, least_z=0.5)
    texture = gaussian_filter(rng.standard_normal((SIDE, SIDE)), 1.5)
    albedo = np.exp(contrast * texture / texture.std())[..., None] * [0.5, 0.4, 0.3]
    images = albedo * np.maximum(np.einsum("rcx,lx->lrc", normal, directions), 0)[..., None]
    for image, direction in zip(images, directions, strict=True) if shake_px or drift_px else ():
        move = rng.normal(0, shake_px, 2) - [drift_px * direction[1], 0]
        image[:] = shift(image, (*move, 0), order=3, mode="nearest")
    images = np.maximum(images + noise * rng.standard_normal(images.shape), 0)
    full = np.ones((SIDE, SIDE), dtype=bool)
    write_capture(folder / "capture", Scene(normal, albedo, full, directions, np.full((LIGHTS, 3), np.pi), images))
    result = solve(SolveRequest(capture=folder / "capture", out=folder / "out", method=method, device="cpu"))
    error, mask = angles_degrees(result.maps.normal, normal), result.maps.mask
    return result.warnings, error[mask] / result.maps.sigma[mask]


def warnings(folder, said="image to image", **scene):
    return [warning for warning in solved(folder, **scene)[0] if said in warning]


@pytest.mark.parametrize("shake_px", [0.2, 0.5])
def test_a_camera_that_shakes_is_named(tmp_path, shake_px):
    """With a move that is not beyond that of the images, √2 times as far as along an axis, and at least half of it while it is small."""
    found, = warnings(tmp_path, shake_px=shake_px)
    told = float(found.split("moves by ")[1].split(" px")[0])
    assert 0.5 * min(shake_px, 0.3) * 2**0.5 < told < 1.2 * shake_px * 2**0.5


@pytest.mark.parametrize(("noise", "contrast"), [(0.02, 0.25), (0.002, 0.25), (0.002, 0.0), (0.02, 0.0)])
def test_a_steady_one_is_not(tmp_path, noise, contrast):
    assert not warnings(tmp_path, "what the camera sees moves", noise=noise, contrast=contrast)


def test_without_texture_nothing_tells(tmp_path):
    assert not warnings(tmp_path, shake_px=0.5, contrast=0.0)


@pytest.mark.parametrize("drift_px", [0.4, 0.8])
def test_a_drift_with_the_light_is_named_and_held_by_sigma(tmp_path, drift_px):
    """Texture turns the normals, and leaves no residual; without what the curl tells, 4 % of them are off by more than five σ."""
    said, ratio = solved(tmp_path, drift_px=drift_px)
    found, = (warning for warning in said if "from one side to the other" in warning)
    told = float(found.split("moves by some ")[1].split(" px")[0])
    assert 0.6 * drift_px * SPAN < told < 1.5 * drift_px * SPAN  # one digit is said
    assert (ratio > 5).mean() < 0.02


def test_a_drift_is_not_taken_for_shaking(tmp_path):
    assert not warnings(tmp_path, drift_px=0.4)
