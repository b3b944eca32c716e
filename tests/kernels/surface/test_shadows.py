"""Cast shadows of a height field, and which pixels support it."""

import math

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.photometric.shadows.shadowing import exclude_shadows
from kernels.surface.normal_map import supported_normals
from kernels.surface.shadows import NO_REACH, Projection, Relief, in_shadow_within, relief_of
from tests.kernels.photometric.test_svbrdf import LIGHTS, render, sample, tilted
from tests.kernels.surface import shapes
from tests.kernels.surface.test_integrate import solve, worst

STEP_AT, STEP_HEIGHT = 40, 10.0


@wp.kernel(enable_backward=False)
def shadow_kernel(relief: Relief, toward: wp.vec3, out: wp.array2d(dtype=wp.uint8)):
    r, c = wp.tid()
    if in_shadow_within(relief, r, c, toward, NO_REACH):
        out[r, c] = wp.uint8(1)


def shadows(height: np.ndarray, mask: np.ndarray, toward, projection: Projection, device: str) -> np.ndarray:
    out = wp.zeros(height.shape, dtype=wp.uint8, device=device)
    relief = relief_of(wp.array(height, dtype=float, device=device), wp.array(mask.astype(np.uint8), dtype=wp.uint8, device=device),
                       projection)
    wp.launch(shadow_kernel, dim=height.shape, inputs=[relief, wp.vec3(*(np.array(toward) / np.linalg.norm(toward)))], outputs=[out],
              device=device)
    return out.numpy().astype(bool)


def orthographic(per_unit: float, side: int) -> Projection:
    return Projection(False, wp.vec2(per_unit, per_unit), wp.vec2(side / 2, side / 2))


def test_up_is_up(device):
    """Rows count down and y up: light from +y is thrown over by what lies higher in the picture."""
    height = np.zeros((40, 40), np.float32)
    height[:10] = 8.0
    dark = shadows(height, np.ones_like(height), (0.0, 1.0, 1.0), orthographic(1.0, 40), device)
    assert dark[11:15, 20].all() and not dark[25:, 20].any() and not dark[:10].any()


def test_a_convex_ball_shadows_nothing(device):
    """On a ball no lit point is hidden; only points that face away from the light may be called so."""
    v, u = np.mgrid[0:60, 0:60] + 0.5 - 30.0
    inside = u**2 + v**2 < 27.0**2
    height = np.where(inside, np.sqrt(np.maximum(27.0**2 - u**2 - v**2, 0)), 0).astype(np.float32)
    normal = np.stack([u, -v, height], axis=-1) / 27.0
    toward = np.array([0.8, 0.3, 0.52])
    dark = shadows(height, inside, toward, orthographic(1.0, 60), device)
    lit = normal @ (toward / np.linalg.norm(toward)) > 0.05
    assert not dark[inside & lit].any()


def test_shadowed_readings_leave_the_samples(device):
    """What lies behind a wall loses exactly the lights that the wall hides; the others keep their readings."""
    samples, _ = sample(render(tilted(16)), device)
    before = samples.grey.numpy().copy()
    height = np.zeros((16, 16), np.float32)
    height[:, 8:] = 100.0
    mask = wp.array(np.ones((16, 16), np.uint8), dtype=wp.uint8, device=device)
    pixels = np.arange(16) * 16 + 4  # column 4 of every row
    exclude_shadows(samples, pixels, wp.array(height, dtype=float, device=device), mask, orthographic(1.0, 16))
    after = samples.grey.numpy()
    colour = samples.colour.numpy()
    flat = [values.reshape(-1, samples.lanes) for values in (before, after)]
    row = 8  # in the middle: the way to any light from the right crosses the wall before it leaves the picture
    for light, direction in enumerate(LIGHTS):
        at = (row // samples.lanes) * samples.pack_stride + light * samples.light_stride
        was, now = flat[0][at, row % samples.lanes], flat[1][at, row % samples.lanes]
        if direction[0] > 0.5 and abs(direction[1]) < 0.5:
            assert now < 0
            assert (colour.reshape(3, -1, samples.lanes)[:, at, row % samples.lanes] < 0).all()
        if direction[0] < -0.1:
            assert now == was
    with pytest.raises(ArrayError, match="pixels must be"):
        exclude_shadows(samples, np.arange(3), wp.array(height, dtype=float, device=device), mask, orthographic(1.0, 16))


def spread(shape, degrees):
    return np.full(shape.mask.shape, degrees, dtype=np.float32)


def spoiled(shape, part, perspective=False, seed=0):
    """Normals that are anything visible in a part of the surface, most of them grazing there, and their standard errors."""
    rng = np.random.default_rng(seed)
    count = part.sum()
    facing, turn = rng.uniform(0.01, 0.3, count), rng.uniform(0, 2 * np.pi, count)
    across = np.sqrt(1 - facing**2)
    normal = shape.normal.copy()
    normal[:, part] = across * np.cos(turn), across * np.sin(turn), facing
    return shape._replace(normal=normal), np.where(part, 45, 0.2).astype(np.float32)


@pytest.mark.parametrize("perspective", [False, True])
def test_sure_normals_stay_as_they_are(perspective, device):
    """The rim of this cap is tilted by 74 degrees: 60 standard errors of a quarter of a degree short of grazing."""
    shape = shapes.cap_in_perspective(80) if perspective else shapes.cap(80)
    plain = solve(shape, device, perspective=perspective).height.numpy()
    none = solve(shape, device, perspective=perspective, sigma=spread(shape, 0)).height.numpy()
    np.testing.assert_array_equal(none, plain)
    sure = solve(shape, device, perspective=perspective, sigma=spread(shape, 0.25)).height.numpy()
    relief = np.ptp(plain[shape.mask])
    assert np.abs(sure - plain)[shape.mask].max() < 1e-5 * relief  # the tolerance of conjugate gradients


@pytest.mark.parametrize("facing, degrees", [(0.02, 10), (0.1, 5), (0.1, 45), (0.5, 45), (-0.1, 20), (0.9, 20)])
def test_the_slope_is_that_of_the_mean_visible_normal(facing, degrees, device):
    """Against the mean of a Gaussian over its positive values, summed in float64."""
    across = math.sqrt(1 - facing**2)
    s, shorter = math.radians(degrees) * across / math.sqrt(2), math.exp(-0.5 * math.radians(degrees) ** 2)
    values = np.linspace(0, max(facing, 0) + 12 * s, 400_001)
    density = np.exp(-0.5 * ((values - shorter * facing) / s) ** 2)
    expected = (values * density).sum() / density.sum() / shorter

    def one(value):
        return wp.array(np.float32(value).reshape(1, 1), dtype=wp.float32, device=device)

    normal = wp.array(np.float32([across, 0, facing]).reshape(3, 1, 1), dtype=wp.float32, device=device)
    found = supported_normals(normal, one(math.radians(degrees)), one(0), one(0), perspective=False, device=device)
    x, y, z = found.normal.numpy()[:, 0, 0]
    assert (x, y) == (pytest.approx(across, rel=1e-6), 0) and z == pytest.approx(expected, rel=1e-4)  # the step of the sum
    assert found.trust.numpy()[0, 0] == pytest.approx(1 / (1 + (degrees / 10) ** 2), rel=1e-5)


@pytest.mark.parametrize("perspective", [False, True])
def test_unsure_normals_make_no_spikes(perspective, device):
    """A patch and single pixels of a cap, among the sure ones around them."""
    shape = shapes.cap_in_perspective(80) if perspective else shapes.cap(80)
    rows, cols = np.mgrid[:80, :80]
    part = shape.mask & ((np.hypot(rows - 35, cols - 45) < 6) | (np.random.default_rng(1).random(shape.mask.shape) < 0.03))
    bad, sigma = spoiled(shape, part)
    assert worst(solve(bad, device, perspective=perspective), shape) > 0.15
    assert worst(solve(bad, device, perspective=perspective, sigma=sigma), shape) < 0.08  # the patch is an eighth of the width


def test_a_surface_of_unsure_normals_alone_keeps_its_span(device):
    """Metal that was taken for matt: normals tilted away by up to 45 degrees more. No surer neighbour is there to follow."""
    shape = shapes.cap(80)
    tilt, turn = np.arccos(shape.normal[2]), np.arctan2(shape.normal[1], shape.normal[0])
    more = np.minimum(tilt * 2, np.radians(89))
    bad = shape._replace(normal=np.stack([np.sin(more) * np.cos(turn), np.sin(more) * np.sin(turn), np.cos(more)]).astype(np.float32))
    truth = np.ptp(shape.z[shape.mask])
    assert np.ptp(solve(bad, device).height.numpy()[shape.mask]) > 4 * truth
    assert np.ptp(solve(bad, device, sigma=spread(shape, 45)).height.numpy()[shape.mask]) < 2 * truth
