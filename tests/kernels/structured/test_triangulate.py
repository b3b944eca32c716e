"""Triangulation against exact geometry in float64: plane and sphere, lens distortion on both devices, and what cannot be."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.structured.decoded import Decoded
from kernels.structured.triangulate import ProjectorModel, triangulate
from tests.reference import projector as reference

CAMERA = reference.Device(96, 72, 150.0, (-0.12, 0.03, 0.0), (0.001, -0.0015))
LENSES = {"ideal": ((0.0, 0.0, 0.0), (0.0, 0.0)), "barrel": ((-0.25, 0.08, -0.01), (0.002, -0.001))}
POSE = reference.look_at((0.25, 0.05, 0.02), (0.0, 0.0, -1.2))
RAYS = reference.pixel_rays(CAMERA)
PLANE = reference.plane_depth(RAYS, (0.0, 0.0, -1.2), (0.3, -0.2, 1.0))
FLOAT32 = 1.5e-5
"""Relative: a coordinate near 500 px held in float32 is good to 3e-5 px, and here one pixel is worth 4e-3 of the depth."""


def projector(lens: str) -> reference.Device:
    return reference.Device(640, 480, 700.0, *LENSES[lens])


def model(device: reference.Device, pose: np.ndarray) -> ProjectorModel:
    turn = reference.FLIP @ pose[:3, :3].T
    return ProjectorModel((device.width, device.height), (device.focal, device.focal), tuple(device.principal), device.k, device.p,
                          np.column_stack([turn, -turn @ pose[:3, 3]]))


def decoded(coordinate, device, sigma=0.1, status=Status.OK) -> Decoded:
    flat = np.asarray(coordinate, dtype=np.float32).ravel()
    return Decoded(wp.array(flat, device=device), wp.array(np.broadcast_to(np.float32(sigma), flat.shape).copy(), device=device),
                   wp.ones(flat.size, dtype=wp.float32, device=device),
                   wp.array(np.broadcast_to(np.uint8(status), flat.shape).copy(), dtype=wp.uint8, device=device))


def solve(device, columns, rows, lens="ideal", pose=POSE, rays=RAYS, **options):
    flat = rays.reshape(-1, 3).astype(np.float32)
    given = {"near_m": 0.0, "far_m": np.inf, "max_residual_px": 3.0, **options}
    found = triangulate(flat[:, 0], flat[:, 1], columns, rows, model(projector(lens), pose), device=device, **given)
    return [array.numpy()[:len(flat)].reshape(rays.shape[:-1]) for array in found]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("axes", ["column", "row", "both"])
@pytest.mark.parametrize("shape", ["plane", "sphere"])
def test_exact_coordinates_give_the_depth_back(device, lens, axes, shape):
    truth = PLANE if shape == "plane" else reference.sphere_depth(RAYS, (0.02, 0.01, -1.3), 0.3)
    pose = POSE if axes != "row" else reference.look_at((0.02, 0.3, 0.0), (0.0, 0.0, -1.2))
    uv = reference.seen_by(projector(lens), pose, RAYS * np.nan_to_num(truth, nan=1.0)[..., None])
    seen = np.isfinite(truth)
    code = np.where(seen, Status.OK, Status.LOW_MODULATION).ravel()
    depth, sigma, residual, status = solve(
        device, decoded(uv[..., 0], device, status=code) if axes != "row" else None,
        decoded(uv[..., 1], device, status=code) if axes != "column" else None, lens, pose)
    assert (status == np.where(seen, Status.OK, Status.LOW_MODULATION)).all()
    assert np.abs(depth[seen] / truth[seen] - 1).max() < FLOAT32
    assert (sigma[seen] > 0).all() and residual[seen].max() < 1e-3
    assert not depth[~seen].any() and not sigma[~seen].any()


def test_it_agrees_with_bisection(device):
    """On pixels whose coordinate belongs to no known surface."""
    barrel, rng = projector("barrel"), np.random.default_rng(1)
    place = rng.integers(0, [CAMERA.height, CAMERA.width], (20, 2))
    rays = RAYS[place[:, 0], place[:, 1]]
    bounds = [reference.seen_by(barrel, POSE, rays * depth)[:, 0] for depth in (0.9, 1.6)]
    u = bounds[0] + rng.random(20) * (bounds[1] - bounds[0])
    twin = [reference.depth_of(ray, column, 0, barrel, POSE, 0.5, 5.0) for ray, column in zip(rays, u, strict=True)]
    depth, *_ = solve(device, decoded(u, device), None, "barrel", rays=rays)
    assert np.abs(depth / twin - 1).max() < FLOAT32


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("axes", ["column", "both"])
def test_sigma_is_the_spread_of_noisy_depths(device, lens, axes):
    rng, spread = np.random.default_rng(3), 0.2
    rays = np.broadcast_to(RAYS[20, 30], (4000, 3))
    uv = reference.seen_by(projector(lens), POSE, rays * 1.2) + rng.normal(0, spread, (4000, 2))
    rows = decoded(uv[:, 1], device, spread) if axes == "both" else None
    depth, sigma, _, status = solve(device, decoded(uv[:, 0], device, spread), rows, lens, rays=rays)
    assert (status == Status.OK).all()
    assert abs(depth.std() / np.median(sigma) - 1) < 0.05  # 4000 samples give 1.1 %


def test_a_coarse_place_may_miss_the_line_by_three_of_its_deviations(device):
    """Ramps out of the noise scatter by more than the residual of finer codes may be: of 4000 all but 0.3 % are kept."""
    rng, spread = np.random.default_rng(4), 6.0
    rays = np.broadcast_to(RAYS[20, 30], (4000, 3))
    uv = reference.seen_by(projector("ideal"), POSE, rays * 1.2) + rng.normal(0, spread, (4000, 2))
    depth, sigma, _, status = solve(device, *(decoded(uv[:, axis], device, spread) for axis in (0, 1)), rays=rays)
    assert (status == Status.OK).mean() > 0.99  # 0.27 % of a normal distribution lie beyond three deviations
    assert 0.6 < np.median(np.abs(depth / 1.2 - 1)[status == Status.OK] * 1.2 / sigma[status == Status.OK]) < 0.75  # 0.67


def test_a_pixel_with_one_decoded_axis_uses_it(device):
    uv = reference.seen_by(projector("barrel"), POSE, RAYS * PLANE[..., None])
    rows = decoded(uv[..., 1] + 400, device, status=Status.UNDECIDED)
    depth, _, _, status = solve(device, decoded(uv[..., 0], device), rows, "barrel")
    assert (status == Status.OK).all() and np.abs(depth / PLANE - 1).max() < FLOAT32


def test_places_that_cannot_be_lit_are_out_of_range(device):
    uv = reference.seen_by(projector("ideal"), POSE, RAYS * PLANE[..., None])
    columns = decoded(uv[..., 0], device)
    assert (solve(device, decoded(uv[..., 0] + 2000, device), None)[3] == Status.OUT_OF_RANGE).all()  # behind the camera
    above = POSE.copy()
    above[:3, 3] += above[:3, 1] * 2  # the rows that light the surface now lie below the projector's image
    assert (solve(device, columns, None, pose=above)[3] == Status.OUT_OF_RANGE).all()
    status = solve(device, columns, decoded(uv[..., 1] + 8, device))[3]
    assert (status == Status.OUT_OF_RANGE).mean() > 0.9  # off the epipolar line by more than the residual allows
    assert (solve(device, columns, None, far_m=1.0)[3][PLANE > 1.01] == Status.OUT_OF_RANGE).all()
    assert (solve(device, columns, None, near_m=2.0)[3] == Status.OUT_OF_RANGE).all()


def test_a_projector_above_the_camera_leaves_columns_ill_posed(device):
    pose = np.eye(4)
    pose[1, 3] = 0.3
    uv = reference.seen_by(projector("ideal"), pose, RAYS * 1.2)
    assert (solve(device, decoded(uv[..., 0], device), None, pose=pose)[3] == Status.ILL_POSED).all()


def test_impossible_calls_are_refused(device):
    flat = np.zeros(10, np.float32)
    shape = model(projector("ideal"), POSE)
    options = {"near_m": 0.0, "far_m": 1.0, "max_residual_px": 1.0, "device": device}
    with pytest.raises(ArrayError, match="neither columns nor rows"):
        triangulate(flat, flat, None, None, shape, **options)
    with pytest.raises(ArrayError, match="y has 9 pixels, x has 10"):
        triangulate(flat, flat[:9], decoded(flat, device), None, shape, **options)
    with pytest.raises(ArrayError, match="a decoded axis has 7 pixels"):
        triangulate(flat, flat, decoded(flat[:7], device), None, shape, **options)
