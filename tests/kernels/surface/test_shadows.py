"""Cast shadows on height fields with a closed form."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.photometric.shadows.shadowing import exclude_shadows
from kernels.surface.shadows import NO_REACH, Projection, Relief, in_shadow_within, relief_of
from tests.kernels.photometric.test_svbrdf import LIGHTS, render, sample, tilted

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
