"""relit solve: the height of surfaces whose normals the method cannot find."""

import json

import numpy as np
import pytest

from kernels.status import Status
from kernels.surface.integrate import integrate_normals
from service.requests.solve import Method, SolveRequest
from service.solve.height.height import whole_surface
from service.solve.height.integrability import LARGEST_TRACE, MIXED, MIXED_DEGREES, beside_parts, doubt, misfit
from service.solve.solve import solve
from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps
from tests.reference.sampling import lattice
from tests.scenes import captures

SHARPNESS = 12
"""Exponent of the highlight of the metal: some 20 degrees wide."""


def metal_cap(folder, lights=24):
    """A cap that reflects as metal does (Blinn), on which no reading is Lambertian."""
    scene = captures.make_scene(size=40, lights=2)
    directions = lattice(lights, np.degrees(np.arccos(0.3)))
    half = directions + [0, 0, 1]
    half /= np.linalg.norm(half, axis=1)[:, None]
    lobe = np.maximum(np.einsum("rcx,lx->lrc", scene.normal, half), 0) ** SHARPNESS
    lobe *= np.einsum("rcx,lx->lrc", scene.normal, directions) > 0
    lobe *= 1 + 0.005 * np.random.default_rng(0).normal(size=lobe.shape)
    images = lobe[..., None] * [0.9, 0.7, 0.4] * scene.mask[None, ..., None]
    return captures.write_capture(folder, scene._replace(directions=directions, irradiance=np.ones((lights, 3)), images=images)), scene


@pytest.mark.long
def test_metal_by_robust_is_unsure_has_no_spikes_and_says_so(tmp_path):
    folder, scene = metal_cap(tmp_path / "capture")
    result = solve(SolveRequest(capture=folder, out=tmp_path / "out", method=Method.ROBUST, device="cpu"))
    maps = SurfaceMaps.read(tmp_path / "out" / "maps.exr", unsure=True)
    error = captures.angles_degrees(maps.normal, scene.normal)
    assert np.median(error[maps.estimated]) > 20
    assert (maps.confidence[maps.estimated] < 0.1).all() and (error > 5 * maps.sigma)[maps.estimated].mean() < 0.01
    assert (maps.status == Status.UNSURE).sum() > 0.5 * maps.estimated.sum()
    true_height = 20 / np.sin(np.radians(45)) * scene.normal[..., 2]  # of a sphere, in pixels
    span = np.ptp(maps.height[maps.estimated]) / np.ptp(true_height[scene.mask])
    assert span < 5  # 11 where every normal counts as sure: nearly all of these are tilted twice as far as the surface
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["height"]["guessed_part"] > 0.1
    assert [w for w in result.warnings if w.startswith("height: ") and w.endswith("try --method svbrdf, which knows highlights and metals")]
    assert report["warnings"] == list(result.warnings)


@pytest.mark.long
def test_a_matt_surface_has_no_such_warning(tmp_path):
    folder = captures.write_capture(tmp_path / "capture", captures.make_scene(size=24, lights=12))
    for method in (Method.LAMBERT, Method.ROBUST):
        result = solve(SolveRequest(capture=folder, out=tmp_path / method, method=method, device="cpu"))
        assert not [w for w in result.warnings if w.startswith("height")]
        assert json.loads((tmp_path / method / "report.json").read_text())["height"]["guessed_part"] == 0


SIDE = 64


def ball() -> tuple[np.ndarray, np.ndarray, np.ndarray, Camera]:
    """[rows, cols, 3] normals and [rows, cols] height of a cap of 50°, its mask and camera."""
    camera = Camera(projection="orthographic", resolution=(SIDE, SIDE))
    x, y = camera.plane_coordinates()
    radius = SIDE / 2 / np.sin(np.radians(50.0))
    z = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0))
    return np.stack([x, y, z], axis=-1) / radius, z, x**2 + y**2 < (SIDE / 2 - 2) ** 2, camera


def test_a_surface_has_no_misfit():
    """Normals and height of a ball; a tenth of a degree: differences of heights on a curve of 40 pixels radius."""
    normal, height, mask, camera = ball()
    assert misfit(normal, height, mask, camera)[mask].max() < 0.1
    assert doubt(normal, height, mask, camera, shared=0.0)[mask].max() < 0.1


@pytest.mark.parametrize("projection", ["orthographic", "perspective"])
def test_integrated_waves_have_hardly_any_misfit(projection):
    """True normals of waves of 12 pixels, which turn by up to 15° from pixel to pixel, and the height integrated from them. What is left,
    0.18° at most, is the curve within a step; differences over two pixels against the mean of five normals were 0.4° apart."""
    perspective = projection == "perspective"
    camera = Camera(projection=projection, resolution=(SIDE, SIDE), **({"focal_px": (300.0, 300.0)} if perspective else {}))
    col, row = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    turn = 2 * np.pi / 12
    one, two = turn * (col + 0.3 * row), turn * (col - row) + 1
    z = 0.7 * (np.sin(one) + np.sin(two)) - (300 if perspective else 0)
    z_col, z_row = 0.7 * turn * (np.cos(one) + np.cos(two)), 0.7 * turn * (0.3 * np.cos(one) - np.cos(two))
    x, y = camera.plane_views()
    flat, pixel = np.zeros_like(z), -z / 300 if perspective else np.ones_like(z)  # what a pixel spans there
    right, down = np.stack([pixel, flat, flat], axis=-1), np.stack([flat, -pixel, flat], axis=-1)
    sight = np.stack([-x, -y, np.ones_like(z)] if perspective else [flat, flat, np.ones_like(z)], axis=-1)
    normal = np.cross(down + z_row[..., None] * sight, right + z_col[..., None] * sight)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    found = integrate_normals(np.moveaxis(normal, -1, 0).astype(np.float32), np.ones(z.shape, dtype=bool), x, y, perspective=perspective,
                              mean_z=float(z.mean()), device="cpu")
    part = np.ones(z.shape, dtype=int)
    assert misfit(normal, found.height.numpy(), part, camera).max() < 0.2


def test_normals_of_no_surface_are_doubted():
    """Normals turned about the view axis by 8° around the ball's middle, which is a curl that no height has."""
    normal, height, mask, camera = ball()
    turn = np.radians(8.0)
    spun = np.stack([normal[..., 0] * np.cos(turn) - normal[..., 1] * np.sin(turn),
                     normal[..., 0] * np.sin(turn) + normal[..., 1] * np.cos(turn), normal[..., 2]], axis=-1)
    found = doubt(spun, height, mask, camera, shared=0.0)
    rim = mask & (normal[..., 2] < 0.75)
    assert np.median(misfit(spun, height, mask, camera)[rim]) > 5
    assert 3 < np.median(found[rim]) < LARGEST_TRACE


def test_a_step_between_parts_is_no_misfit():
    """Half of the ball lies 20 pixels nearer: differences of heights across the step show no normal, those beside it what they did."""
    normal, height, mask, camera = ball()
    nearer = np.arange(SIDE)[None] < SIDE // 2
    stepped = height + 20.0 * nearer
    assert doubt(normal, stepped, np.where(mask, 1 + nearer, 0), camera, shared=0.0)[mask].max() < 0.1
    assert doubt(normal, stepped, mask.astype(int), camera, shared=0.0)[:, SIDE // 2][mask[:, SIDE // 2]].min() > 1


def test_pixels_beside_another_part_are_doubted():
    """They may see both parts. Pixels along the outline of the object, and inside a part, keep their standard deviation."""
    part = np.zeros((8, 8), dtype=int)
    part[1:7, 1:4], part[1:7, 4:7] = 1, 2
    raised = beside_parts(np.full(part.shape, 0.5), part)
    beside = np.zeros_like(part, dtype=bool)
    beside[1:7, 3:5] = True
    np.testing.assert_allclose(raised[beside], np.hypot(0.5 * MIXED, MIXED_DEGREES))
    np.testing.assert_array_equal(raised[~beside], 0.5)


def test_the_size_of_bands_changes_nothing(monkeypatch):
    normal, height, mask, camera = ball()
    spoiled = normal + np.random.default_rng(0).normal(0, 0.1, normal.shape)
    whole = misfit(spoiled, height, mask, camera)
    monkeypatch.setattr("service.solve.height.integrability.BAND_PIXELS", 5 * SIDE)
    np.testing.assert_array_equal(misfit(spoiled, height, mask, camera), whole)


ROWS, COLS = 20, 30
V, U = np.mgrid[:ROWS, :COLS]
SLOPE = 0.5 * U + 0.2 * V
FULL = np.ones((ROWS, COLS), dtype=bool)


def test_what_is_solved_keeps_its_shape_and_the_mask_gets_the_mean():
    solved = (U > 2) & (V < 15)
    out = whole_surface(SLOPE.astype(np.float32), solved, FULL, mean_z=7.0, perspective=False)
    assert out.dtype == np.float32 and out.mean() == pytest.approx(7, abs=1e-5)
    apart = (out - SLOPE)[solved]
    assert np.ptp(apart) < 1e-5
    rim = np.abs(out - SLOPE - apart.mean())[:15, :3]
    assert rim[:, 2].max() == pytest.approx(0.5, abs=1e-5)  # one pixel of slope, not extrapolated
    assert rim.max() == pytest.approx(1.5, abs=0.2)


def test_a_perspective_surface_is_scaled():
    depth = -5 - 0.01 * SLOPE
    out = whole_surface(depth.astype(np.float32), FULL, FULL, mean_z=-2.0, perspective=True)
    assert np.allclose(out / depth, -2.0 / depth.mean()) and out.mean() == pytest.approx(-2)


@pytest.mark.parametrize("perspective", [False, True])
def test_islands_go_where_the_mainland_reaches_them(perspective):
    """Unsolved pixels part a corner from the rest of the mask, so that its constant is not known."""
    surface = -40 - 0.1 * SLOPE
    solved = ~((U == 24) | (V == 15) & (U > 24))
    corner = (U > 24) & (V < 15)
    below = (U > 24) & (V > 15)
    loose = np.where(corner, surface * 1.3, np.where(below, surface * 0.8, surface)) if perspective else (
        surface + np.where(corner, 9, 0) - np.where(below, 4, 0))
    out = whole_surface(np.where(solved, loose, 0).astype(np.float32), solved, FULL, mean_z=-42.0, perspective=perspective)
    error = out / surface / (out / surface)[0, 0] * 40 - 40 if perspective else out - surface - (out - surface)[0, 0]
    assert np.abs(error)[solved & (U < 24)].max() < 1e-4
    assert np.abs(error)[corner | below].max() < 0.5  # two pixels of slope 0.1, and the rest of the way across: from 9 and 4


def test_parts_of_the_mask_that_do_not_touch_stay_where_they_are():
    mask = (U < 10) | (U > 20)
    height = np.where(U < 10, 1.0, 5.0) * mask
    out = whole_surface(height.astype(np.float32), mask, mask, mean_z=float(height[mask].mean()), perspective=False)
    assert np.allclose(out[mask], height[mask], atol=1e-6)
    assert ((out > 0.99) & (out < 5.01)).all()


def test_one_solved_pixel_and_a_large_gap():
    solved = np.zeros((600, 501), dtype=bool)
    solved[3, 4] = True
    height = np.where(solved, 3.0, np.nan).astype(np.float32)
    assert np.allclose(whole_surface(height, solved, np.ones_like(solved), mean_z=2.0, perspective=False), 2.0)
