"""Captures during which the object slid before the camera are told from steady ones by outlines and shading."""

import numpy as np
import pytest
from scipy.ndimage import shift

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from tests.marks import first_short
from tests.scenes.captures import Scene, angles_degrees, write_capture
from tests.scenes.parts import sphere_lights
from tests.scenes.surfaces import make_ball

SIDE, NOISE = 64, 0.002


def solved(folder, slide_px, *, lights=24, wide=0.0, method=Method.ROBUST):
    """What a solve says of a plain ball before a black ground that moves to the right after the first image, and the error of each normal
    over its σ. `wide`: strength of a wide highlight."""
    rng = np.random.default_rng(1)
    ball = make_ball(SIDE)
    directions = sphere_lights(lights, least_z=0.5)
    halves = directions + [0, 0, 1]
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    facing, shine = (np.maximum(np.einsum("rcx,lx->lrc", ball.normal, vectors), 0) for vectors in (directions, halves))
    images = (facing * (1 + wide * shine**20))[..., None] * [0.5, 0.4, 0.3]
    for image, time in zip(images, np.linspace(0, 1, lights), strict=True):
        image[:] = shift(image, (0, slide_px * time, 0), order=1)
    images = np.maximum(images + NOISE * rng.standard_normal(images.shape), 0)
    albedo = np.where(ball.mask[..., None], [0.5, 0.4, 0.3], 0)
    write_capture(folder / "capture", Scene(ball.normal, albedo, ball.mask, directions, np.full((lights, 3), np.pi), images))
    result = solve(SolveRequest(capture=folder / "capture", out=folder / "out", method=method, device="cpu"))
    error, known = angles_degrees(result.maps.normal, ball.normal), result.maps.mask
    return [warning for warning in result.warnings if "what the camera sees moves" in warning], error[known] / result.maps.sigma[known]


@first_short("slide_px", [2.0, 4.0])
def test_a_slide_is_named(tmp_path, slide_px):
    """With its length, rather too little: the solved normals have taken up a part of it."""
    found, = solved(tmp_path, slide_px)[0]
    assert "from the first image to the last" in found
    assert 0.5 * slide_px < float(found.split("by some ")[1].split(" px")[0]) < 1.2 * slide_px


@pytest.mark.long
def test_sigma_holds_what_a_slide_makes(tmp_path):
    """Lobes explain what moves; the 95th percentile of error over σ would be 3.6 without what is known of the slide."""
    assert np.quantile(solved(tmp_path, 4.0, lights=40, wide=0.5, method=Method.SVBRDF)[1], 0.95) < 2.5


@pytest.mark.long
@pytest.mark.parametrize("wide", [0.5, 0.0])
def test_a_steady_object_is_not(tmp_path, wide):
    assert solved(tmp_path, 0.0, wide=wide)[0] == []
