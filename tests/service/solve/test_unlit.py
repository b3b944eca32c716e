"""A black background, whose readings are noise, is told from an object, with a mask and without one, and what a lamp lights stays."""

import json

import numpy as np
import pytest

from kernels.status import Status
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.errors import ManifestError
from tests.scenes.captures import distant, ring, write_lit

SIDE, RADIUS = 48, 0.55


def ball(albedo: float, back: float, lights: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return images [lights, rows, cols] under irradiance π of a matt ball before a wall of another albedo, where the ball is, and the
    directions."""
    at = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    x, y = np.meshgrid(at, -at)
    inside = x**2 + y**2 < RADIUS**2
    normal = np.where(inside, [x / RADIUS, y / RADIUS, np.sqrt(np.maximum(1 - (x**2 + y**2) / RADIUS**2, 0))], [[[0]], [[0]], [[1]]])
    directions = ring(lights)
    return np.where(inside, albedo, back) * np.maximum(np.einsum("lc,crk->lrk", directions, normal), 0), inside, directions


def solved(folder, albedo, back, noise, *, cut, mask=None, lights=8, name="{:03d}.png"):
    """Return status [rows, cols], normals, the report of a solve of noisy images, and where the ball is; `cut`: whether noise below zero
    is lost, as in files of integers; `mask`: [rows, cols] bool, None without one."""
    images, inside, directions = ball(albedo, back, lights)
    strength = noise * np.linspace(1, 2, lights)[:, None, None]  # frames of different exposures
    images = images + strength * np.random.default_rng(4).normal(size=images.shape)
    write_lit(folder, np.maximum(images, 0) if cut else images, (distant(each, np.pi) for each in directions), mask=mask, names=name,
              camera={"projection": "orthographic", "resolution": [SIDE, SIDE]})
    result = solve(SolveRequest(capture=folder, out=folder / "out", method=Method.ROBUST, clip_negative=not cut))
    assert result.maps.status is not None and result.maps.normal is not None
    return result.maps.status, result.maps.normal, json.loads(result.report_path.read_text()), inside


def disk(wider: int) -> np.ndarray:
    """Return the outline of the ball, so many pixels wider."""
    return np.hypot(*(np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2)) < RADIUS * SIDE / 2 + wider


@pytest.mark.parametrize(("cut", "name"), [(True, "{:03d}.png"), (False, "{:03d}.exr")])
def test_a_black_background_is_dark_without_a_mask(tmp_path, cut, name):
    """All of it but the pixels that the rim of the ball touches, and none of the ball of albedo 0.1, which is 50 to 100 times as bright
    as the noise where it faces its lamps; the report counts them."""
    status, _, report, inside = solved(tmp_path, 0.1, 0.0, 0.001, cut=cut, name=name)
    assert (status[~inside] == Status.DARK).mean() > 0.97 and not (status[inside] == Status.DARK).any()
    assert report["pixels"]["dark"] == (status == Status.DARK).sum() and report["pixels"]["mask"] == SIDE**2


def test_a_mask_that_is_too_wide_solves_as_a_right_one(tmp_path):
    """Normals of the ball under a mask with four more pixels around it are those without them: what is not solved tells them nothing."""
    wide, normal, _, inside = solved(tmp_path / "wide", 0.5, 0.0, 0.002, cut=True, mask=disk(4))
    right, expected, _, _ = solved(tmp_path / "right", 0.5, 0.0, 0.002, cut=True, mask=disk(0))
    both = inside & (wide == right)
    assert both.sum() > 0.98 * inside.sum() and (wide == Status.DARK).sum() > 0.9 * (disk(4) & ~inside).sum()
    np.testing.assert_allclose(normal[both], expected[both], atol=1e-3)  # as half values


@pytest.mark.parametrize(("albedo", "back", "noise"), [(0.5, 0.02, 0.002), (0.02, 0.5, 0.002), (0.02, 0.02, 0.004)])
def test_what_a_lamp_lights_is_no_background(tmp_path, albedo, back, noise):
    """A black wall, a black ball and both of albedo 0.02, in noise of a tenth to a fifth of their readings."""
    status, _, _, _ = solved(tmp_path, albedo, back, noise, cut=True)
    assert not (status == Status.DARK).any()


def test_a_mask_beside_the_object_is_refused(tmp_path):
    """A corner of the background has nothing to solve."""
    with pytest.raises(ManifestError, match="mask: no light"):
        solved(tmp_path, 0.5, 0.0, 0.002, cut=True, mask=np.add.outer(np.arange(SIDE), np.arange(SIDE)) < SIDE // 4)
    assert not (tmp_path / "out").exists()
