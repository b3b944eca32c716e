"""Cast shadows of a height field, which pixels support it, and light between its patches."""

import math

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.photometric.lambertian.near import NearField, pad_places
from kernels.photometric.material.material import fit_tinted
from kernels.photometric.model.samples import readings_of, to_host
from kernels.photometric.search.hypotheses import LobeShape
from kernels.photometric.shadows.bounce import bounce_albedo, subtract_bounce
from kernels.photometric.shadows.shadowing import exclude_shadows
from kernels.surface.interreflection import gather_light
from kernels.surface.normal_map import supported_normals
from kernels.surface.shadows import NO_REACH, Projection, Relief, in_shadow_within, relief_of
from tests.kernels.photometric.test_svbrdf import LIGHTS, render, sample, tilted
from tests.kernels.surface import shapes
from tests.kernels.surface.test_integrate import solve, worst
from tests.reference.groove import Groove
from tests.reference.sampling import lattice

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


def arriving_on(groove: Groove, radiance: np.ndarray, device: str, *, height=None, normals=None, opening=0.0) -> np.ndarray:
    """What arrives at each patch of a groove; with the unit matrix as radiance these are the form factors."""
    side = groove.side
    z = (groove.points[:, 2].reshape(side, side) if height is None else height).astype(np.float32)
    cells = np.stack(np.divmod(np.arange(side**2), side), axis=1)
    return gather_light(groove.points, groove.normals if normals is None else normals, groove.areas, cells, radiance,
                        wp.array(z, dtype=wp.float32, device=device), wp.ones((side, side), dtype=wp.uint8, device=device),
                        Projection(False, wp.vec2(1.0, 1.0), wp.vec2(side / 2, side / 2)), device=device, opening=opening)


def factors_of(groove: Groove, device: str, *, height=None) -> np.ndarray:
    return arriving_on(groove, np.eye(groove.side**2, dtype=np.float32), device, height=height)


def test_factors_agree_with_float64(device):
    groove = Groove(16)
    np.testing.assert_allclose(factors_of(groove, device), groove.factors(), rtol=1e-4, atol=1e-7)  # float32


@pytest.mark.parametrize("opening, within", [(0.25, 0.03), (0.5, 0.15)])
def test_far_patches_send_as_groups(device, opening, within):
    """A group stands for its members to second order in its size over its distance. The seam is the worst place, because the groups
    that face it are large; the light of uneven patches is weighted by their area."""
    groove = Groove(32)
    radiance = np.random.default_rng(1).uniform(0.5, 1.5, (32**2, 5)).astype(np.float32)
    exact = groove.factors() @ radiance
    found = arriving_on(groove, radiance, device, opening=opening)
    np.testing.assert_allclose(found, exact, atol=within * exact.mean())
    assert np.abs(found - exact).max() > 1e-4 * exact.mean()  # groups did send


def test_the_two_sides_of_a_ridge_do_not_cancel(device):
    """Narrow pleats seen from afar: those of their faces that look at a patch send it light, and those that look away do not take it
    back, as a group of mean normal would."""
    side = 32
    groove = Groove(side)
    pleats = np.tile(np.where(np.arange(side) % 2 == 0, 1.0, -1.0), side)
    left = groove.points[:, 0] < 0
    slant = np.stack([pleats, np.zeros(side**2), np.ones(side**2)], axis=1) / np.sqrt(2)
    normals = np.where(left[:, None], slant, groove.normals)
    radiance = np.ones((side**2, 1), dtype=np.float32)
    exact, found = (arriving_on(groove, radiance, device, normals=normals, opening=opening)[~left] for opening in (0.0, 0.25))
    np.testing.assert_allclose(found, exact, atol=0.05 * exact.mean())


def plates_at_right_angles(width: float, length: float) -> float:
    """What one rectangle sends to an equal one that shares its long edge at a right angle (Howell, configuration C-14)."""
    h = w = width / length
    both = h * h + w * w
    logarithm = np.log((1 + w**2) * (1 + h**2) / (1 + both)
                       * (w**2 * (1 + both) / ((1 + w**2) * both)) ** (w**2) * (h**2 * (1 + both) / ((1 + h**2) * both)) ** (h**2))
    return (2 * w * np.arctan(1 / w) - np.sqrt(both) * np.arctan(1 / np.sqrt(both)) + logarithm / 4) / (np.pi * w)


@pytest.mark.parametrize("side", [20, pytest.param(40, marks=pytest.mark.long)])
def test_a_groove_has_its_closed_form(device, side):
    """The faces' mean row sum is the form factor between them. Patches at the seam are as far apart as they are large, which costs
    some of their exchange: an error that falls with the size of the patches, 12 % and 6 % of the whole here."""
    total = factors_of(Groove(side), device).sum(axis=1)
    expected = plates_at_right_angles(side / np.sqrt(2), side)
    assert total.mean() == pytest.approx(expected, rel=2.4 / side)
    middle = total.reshape(side, side)[side // 2]
    assert (np.diff(middle[: side // 2]) > 0).all()  # more, the closer to the seam


def test_a_wall_between_hides(device):
    """A ridge along the seam, in the height but in no patch: the faces no longer see each other through it."""
    groove = Groove(16)
    height = groove.points[:, 2].reshape(16, 16).copy()
    height[:, 7:9] = 40.0
    free, hidden = factors_of(groove, device), factors_of(groove, device, height=height)
    across = np.ix_(np.flatnonzero(groove.points[:, 0] < -4), np.flatnonzero(groove.points[:, 0] > 4))
    seen = free[across] > 1e-4
    assert seen.any() and (hidden[across][seen] == 0).mean() > 0.95


def test_shapes_are_checked(device):
    groove = Groove(4)
    with pytest.raises(ArrayError, match="radiance"):
        arriving_on(groove, np.ones((15, 1), np.float32), device)
    groove.areas = groove.areas[:-1]
    with pytest.raises(ArrayError, match="areas"):
        factors_of(groove, device)


def test_taking_off_the_bounce_leaves_the_direct_light(device):
    """radiance = direct + ρ K radiance: with the true K and albedo what is left is the direct light, to half rounding of the images."""
    groove, lights, albedo = Groove(12), lattice(16, 40.0), 0.7
    whole, direct = groove.radiance(lights, albedo)
    assert np.median(whole / np.maximum(direct, 1e-9)) > 1.05  # the bounces are no trifle
    samples, _ = sample(np.repeat(whole[None], 3, axis=0), device, lights=lights)
    arriving = np.repeat((groove.factors() @ whole.T)[:, None], 3, axis=1)
    count = groove.side**2
    corners = np.stack([np.arange(count)] * 4, axis=1)
    shares = np.tile(np.array([0.1, 0.2, 0.3, 0.4], dtype=np.float32), (count, 1))
    subtract_bounce(samples, arriving, corners, shares, np.full((count, 3), albedo), np.array([0.3, 0.6, 0.1]))
    at = np.array([[p * samples.pack_stride + light * samples.light_stride for p in range(samples.packs)] for light in range(16)])
    grey = samples.grey.numpy().reshape(-1, samples.lanes)[at].reshape(16, -1)[:, :count] * to_host(samples, samples.level)
    red = samples.colour.numpy().reshape(3, -1, samples.lanes)[0][at].reshape(16, -1)[:, :count]
    np.testing.assert_allclose(grey, direct, atol=1.2 * 2**-11 * whole.max())  # and the float32 of what is taken off
    np.testing.assert_allclose(red, direct, atol=1.2 * 2**-11 * whole.max())
    with pytest.raises(ArrayError, match="corners must be"):
        subtract_bounce(samples, arriving, corners + 1, shares, np.full((count, 3), albedo), np.array([0.3, 0.6, 0.1]))


def test_bounced_light_is_that_of_the_whole_reflection(device):
    """Soft light added to a surface is taken by the fit for a wide tinted lobe, in place of the diffuse one; a matt fit keeps it. A
    metal has no diffuse reflection, whatever a matt fit would call it."""
    normal = tilted(60)
    colour = np.array([0.6, 0.5, 0.4])
    soft = 0.04 * colour[:, None, None] * (1 + LIGHTS[None, :, None, 0])  # as a wall beside it sends
    samples, _ = sample(render(normal, albedo=colour, alpha=0.1) + soft, device)
    tinted = fit_tinted(samples, normal.astype(np.float32), shape=LobeShape())
    found = bounce_albedo(samples, normal.astype(np.float32), tinted, shape=LobeShape())
    wrong, alone = (np.quantile(np.abs(np.log(np.maximum(albedo, 1e-3) / colour)), 0.9) for albedo in (found, tinted.diffuse_albedo))
    assert wrong < 0.3  # the added light is 10 to 20 % of the diffuse
    assert alone > 0.3
    samples, _ = sample(render(normal, albedo=np.zeros(3), alpha=0.16, f0=0.8), device)
    tinted = fit_tinted(samples, normal.astype(np.float32), shape=LobeShape())
    assert bounce_albedo(samples, normal.astype(np.float32), tinted, shape=LobeShape()).max() < 0.05


def test_near_light_is_taken_off_in_the_unit_of_each_reading(device):
    """A reading under a near light is radiance over intensity and falloff, and what arrives is radiance over intensity."""
    rng = np.random.default_rng(5)
    count, lights, albedo = 40, 8, 0.5
    points = rng.uniform(-1, 1, (3, count)).astype(np.float32)
    lamps = np.concatenate([rng.uniform(2, 3, (lights, 3)), np.ones((lights, 1))], axis=1)
    lamps[-1] = 0, 0, 1, 0  # a distant one among them
    field = NearField(pad_places(lamps, np.zeros((lights, 4))), points)
    way = lamps[:, None, :3] - points.T
    falloff = np.where(lamps[:, 3:] > 0, 1 / (way**2).sum(axis=-1), 1)
    direct, arriving = rng.uniform(0.2, 0.4, (lights, count)), rng.uniform(0.1, 0.3, (count, lights))
    stored = (direct * falloff + albedo * arriving.T).astype(np.float16).astype(float)
    samples, _ = sample(np.repeat(stored[None], 3, axis=0), device, lights=np.tile([0.0, 0.0, 1.0], (lights, 1)), field=field)
    corners = np.stack([np.arange(count)] * 4, axis=1)
    subtract_bounce(samples, np.repeat(arriving[:, None], 3, axis=1), corners, np.full((count, 4), 0.25, np.float32),
                    np.full((count, 3), albedo), np.full(3, 1 / 3), field)
    np.testing.assert_allclose(readings_of(samples).T, direct, atol=2**-11 * (stored / falloff).max())  # half rounding of the images
    with pytest.raises(ArrayError, match="points are"):
        subtract_bounce(samples, np.repeat(arriving[:, None], 3, axis=1), corners, np.full((count, 4), 0.25, np.float32),
                        np.full((count, 3), albedo), np.full(3, 1 / 3), field.at(np.arange(3)))
