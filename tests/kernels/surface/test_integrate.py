"""Heights from normals against closed forms, and what calls and pixels may do wrong."""

import numpy as np
import pytest
import warp as wp

from kernels import graphs
from kernels.errors import ArrayError
from kernels.surface.conjugate import CHECK_EVERY
from kernels.surface.integrate import IntegrationOptions, integrate_normals
from tests.kernels.surface import shapes
from tests.reference import surface as reference


def solve(shape, device, *, perspective=False, mean_z=None, sigma=None, kind=None, **options):
    if mean_z is None:
        mean_z = float(shape.z[shape.mask].mean())
    return integrate_normals(
        shape.normal, shape.mask, shape.x, shape.y, perspective=perspective, mean_z=mean_z, sigma=sigma, kind=kind,
        options=IntegrationOptions(**options), device=device,
    )


def worst(result, shape):
    """Largest error over relief."""
    error = result.height.numpy() - shape.z
    return np.abs(error[shape.mask]).max() / np.ptp(shape.z[shape.mask])


PLANES = {f"{rows} x {cols}": shapes.plane(rows, cols) for rows, cols in ((31, 47), (64, 64), (1, 50), (37, 1), (2, 2), (3, 2), (1, 2))}
EXACT = {**PLANES, "of 1 mm": shapes.plane(40, 33, size=1e-3), "of 4 km": shapes.plane(40, 33, size=4000.0), "cap": shapes.cap(200),
         "cap in perspective": shapes.cap_in_perspective(200)}


@pytest.mark.parametrize("name", EXACT)
def test_planes_and_caps_are_exact(name, device):
    """The chord rule has no error of its own here: float32 normals and the tolerance of 1e-6 are left, measured 4e-7. In perspective relief
    is a tenth of the depth, so that rounding counts more, and the mean is that which was given."""
    shape, perspective = EXACT[name], name.endswith("perspective")
    result = solve(shape, device, perspective=perspective)
    assert result.converged and result.components == 1
    assert worst(result, shape) < (1e-5 if perspective else 3e-6)
    assert not perspective or result.height.numpy()[shape.mask].mean() == pytest.approx(shape.z[shape.mask].mean(), rel=1e-6)


def test_perspective_plane_with_distorted_pixels_is_exact(device):
    x, y = shapes.plane_coordinates(60, 80)
    bend = 1 + 0.2 * (x**2 + y**2)
    x, y = x * bend, y * bend
    normal = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    z = -2.0 * normal[2] / (normal[2] - normal[0] * x - normal[1] * y)
    shape = shapes.Shape(
        np.broadcast_to(normal[:, None, None], (3, *x.shape)).astype(np.float32), np.ones(x.shape, dtype=bool),
        x.astype(np.float32), y.astype(np.float32), z,
    )
    assert worst(solve(shape, device, perspective=True), shape) < 1e-5


def test_small_relief_survives_a_long_row(device):
    """Steps of a few millionths between pixels, 4096 times: a logarithm in float32 would lose 1 % of the relief."""
    x, y = shapes.plane_coordinates(3, 4096, size=0.36)
    tilt = np.array([0.02, 0.0, 1.0]) / np.hypot(0.02, 1.0)
    z = -2.0 * tilt[2] / (tilt[2] - tilt[0] * x)
    normal = np.broadcast_to(tilt[:, None, None], (3, 3, 4096)).astype(np.float32)
    shape = shapes.Shape(normal, np.ones((3, 4096), dtype=bool), x.astype(np.float32), y.astype(np.float32), z)
    error = np.abs(solve(shape, device, perspective=True).height.numpy() - z).max()
    assert error < 5e-7  # float32 holds z = −2 to 1.2e-7; the relief is 0.0144


def test_bumps_converge_with_the_square_of_the_pixel(device):
    errors = [worst(solve(shapes.bumps(n), device), shapes.bumps(n)) for n in (48, 96, 192)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.15)


def test_nothing_bows_a_noisy_plane(device):
    """The known failure of slopes weighted by their own variance: noise flattens the surface into a bowl."""
    shape = shapes.plane(200, 200, slope_x=1.0, slope_y=0.0)
    noisy = shape.normal + np.random.default_rng(0).normal(0, 0.05, shape.normal.shape).astype(np.float32)
    height = solve(shape._replace(normal=noisy), device).height.numpy()
    slope = np.polyfit(shape.x[100].astype(float), height.mean(0), 1)[0]
    assert slope == pytest.approx(1.0, abs=0.002)  # second order in the noise, 0.05²; inverse variance gives 0.995


def test_masked_step_has_two_heights(device):
    """Two planes at different depths with a gap between: each part keeps its shape and its own mean."""
    shape = shapes.plane(50, 81)
    shape.mask[:, 40] = False
    shape.z[:, 41:] += 5.0
    result = solve(shape, device, mean_z=0.25)
    assert result.components == 2
    height = result.height.numpy()
    for part in (np.s_[:, :40], np.s_[:, 41:]):
        assert height[part].mean() == pytest.approx(0.25, abs=1e-6)
        assert np.abs(height[part] - 0.25 - (shape.z[part] - shape.z[part].mean())).max() < 3e-6
    assert (height[:, 40] == 0.0).all()


@pytest.mark.parametrize("discontinuities", [False, True])
def test_lone_pixels_lie_at_the_mean(discontinuities, device):
    shape = shapes.plane(9, 11)
    mask = np.zeros((9, 11), dtype=bool)
    mask[::2, ::3] = True
    result = solve(shape._replace(mask=mask), device, mean_z=1.5, discontinuities=discontinuities)
    assert result.components == mask.sum()
    assert result.iterations == 0
    assert result.converged
    np.testing.assert_array_equal(result.height.numpy(), np.where(mask, np.float32(1.5), 0))


def test_one_pixel(device):
    one = np.ones((1, 1), dtype=np.float32)
    normal = np.array([0, 0, 1], dtype=np.float32).reshape(3, 1, 1)
    result = integrate_normals(normal, one > 0, 0 * one, 0 * one, perspective=True, mean_z=-2.0, device=device)
    assert result.height.numpy()[0, 0] == pytest.approx(-2.0)


def test_bad_pixels_leave_the_mask(device):
    shape = shapes.bumps(40)
    holes = np.zeros((40, 40), dtype=bool)
    holes[5:8, 9], holes[20, 20], holes[30, 3:9] = True, True, True
    broken = shape.normal.copy()
    broken[:, 5:8, 9], broken[1, 20, 20], broken[:, 30, 3:9] = np.nan, np.inf, 0.0
    damaged = solve(shape._replace(normal=broken), device, mean_z=0.0).height.numpy()
    masked = solve(shape._replace(mask=~holes), device, mean_z=0.0).height.numpy()
    np.testing.assert_array_equal(damaged, masked)
    assert (damaged[holes] == 0.0).all()


@pytest.mark.parametrize("discontinuities", [False, True])
def test_only_bad_pixels(discontinuities, device):
    shape = shapes.bumps(8)
    result = solve(shape._replace(normal=np.full_like(shape.normal, np.nan)), device, mean_z=1.0, discontinuities=discontinuities)
    assert result.components == 0
    assert (result.height.numpy() == 0.0).all()


def test_a_normal_that_faces_away_makes_no_spike(device):
    shape = shapes.bumps(64)
    broken = shape.normal.copy()
    broken[:, 30, 30] = (0, 0, -1)
    broken[:, 40, 20] = (0.8, 0, -0.6)
    error = np.abs(solve(shape._replace(normal=broken), device).height.numpy() - shape.z)
    assert error.max() < 0.2 * np.ptp(shape.z)  # its own pixel is lost, but it stays on the surface
    error[27:34, 27:34] = error[37:44, 17:24] = 0
    assert error.max() < 0.02 * np.ptp(shape.z)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["sphere", "bumps", "perspective"])
def test_iterations_do_not_grow_with_the_picture(kind, device):
    for n in (64, 1024):
        shape = {"sphere": shapes.cap, "bumps": shapes.bumps, "perspective": shapes.cap_in_perspective}[kind](n)
        if kind == "bumps":
            shape = shape._replace(mask=shapes.ragged_mask(n, n))
        result = solve(shape, device, perspective=kind == "perspective")
        assert result.converged
        assert result.iterations <= 14  # 7; with a ragged mask full of holes 9 at 64² and 10 at 1024²


def test_result_says_when_it_gave_up(device):
    result = solve(shapes.bumps(64), device, max_iterations=1)
    assert not result.converged
    assert result.iterations == 1
    assert result.residual > 1e-6


def test_a_tolerance_below_rounding_spoils_nothing(device):
    """Float32 heights do not come closer than some 1e-6; the iterations end once the residual has grown a hundredfold from there (after a
    group of four on CUDA), and do not divide rounding errors by each other, which made heights of many times the object's size."""
    shape = shapes.cap(48)
    plain, pushed = solve(shape, device), solve(shape, device, tolerance=1e-10)
    assert pushed.iterations < 200
    np.testing.assert_allclose(pushed.height.numpy(), plain.height.numpy(), atol=1e-3 * np.ptp(shape.z))


def test_graphs_of_launches_give_the_same(monkeypatch):
    """Warp captures and replays launches on the CPU too, as long as one core makes them."""
    shape, launched = shapes.bumps(60, shapes.ragged_mask(60, 60)), []
    plain = solve(shape, "cpu")
    launch_graph = wp.capture_launch
    monkeypatch.setattr(graphs, "has_graphs", lambda device: True)
    monkeypatch.setattr(wp, "capture_launch", lambda graph: launched.append(graph) or launch_graph(graph))
    result = solve(shape, "cpu")
    assert len(launched) > len(set(launched)) == 1  # one graph, launched several times
    assert len(launched) == -(-plain.iterations // CHECK_EVERY)
    found, expected = result.height.numpy()[shape.mask], plain.height.numpy()[shape.mask]
    # the last group goes on to the goal on the device, and no further
    np.testing.assert_array_equal(found, expected)


def test_arrays_on_the_device_give_the_same(device):
    shape = shapes.bumps(50, shapes.ragged_mask(50, 50))
    there = [wp.array(a, device=device) for a in (shape.normal, shape.mask, shape.x, shape.y)]
    moved = integrate_normals(*there, perspective=False, mean_z=0.0, device=device)
    np.testing.assert_array_equal(moved.height.numpy(), solve(shape, device, mean_z=0.0).height.numpy())


def test_progress_rises_to_one(device):
    shape, told = shapes.bumps(64), []
    integrate_normals(
        shape.normal, shape.mask, shape.x, shape.y, perspective=False, mean_z=0.0, device=device, progress=told.append
    )
    assert len(told) > 1
    assert told[-1] == 1.0
    assert all(0.0 <= t <= 1.0 for t in told)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normal": np.zeros((8, 9, 3), dtype=np.float32)}, r"normal has shape \(8, 9, 3\)"),
        ({"x": np.zeros((9, 8), dtype=np.float32)}, r"x has shape \(9, 8\)"),
        ({"sigma": np.zeros((9, 8), dtype=np.float32)}, r"sigma has shape \(9, 8\)"),
        ({"mask": np.zeros((8, 9), dtype=bool)}, "mask is empty"),
        ({"mask": np.ones(9, dtype=bool)}, "mask has shape"),
        ({"mean_z": 0.5, "perspective": True}, "mean_z is 0.5"),
        ({"mean_z": float("nan")}, "mean_z is nan"),
    ],
)
def test_bad_calls_raise(change, message, device):
    call = {
        "normal": np.zeros((3, 8, 9), dtype=np.float32), "mask": np.ones((8, 9), dtype=bool),
        "x": np.zeros((8, 9), dtype=np.float32), "y": np.zeros((8, 9), dtype=np.float32), "perspective": False, "mean_z": 0.0,
    } | change
    with pytest.raises(ArrayError, match=message):
        integrate_normals(**call, device=device)


@pytest.mark.parametrize("size", [(61, 83), (64, 64), (97, 40)])
@pytest.mark.parametrize("perspective", [False, True])
def test_random_bumpy_normals(size, perspective, device):
    """Normals that no surface has: the two must agree on the best fit."""
    rng = np.random.default_rng(size[0])
    normal = rng.normal(0, 0.4, (3, *size)) + np.array([0, 0, 1.5])[:, None, None]
    normal = (normal / np.linalg.norm(normal, axis=0)).astype(np.float32)
    normal[:, normal[2] < 0.35] = np.array([[0], [0], [1]], dtype=np.float32)
    mask = shapes.ragged_mask(*size, seed=size[1])
    x, y = (a.astype(np.float32) for a in shapes.plane_coordinates(*size, size=0.4))
    how = {"perspective": perspective, "mean_z": -2.0}
    result = integrate_normals(normal, mask, x, y, **how, device=device)
    truth = reference.integrate(normal, mask, x, y, **how)
    assert result.converged
    height = result.height.numpy()
    # float32 rounding of the result (1e-7 of z = −2) and the stopping tolerance
    assert np.abs(height - truth).max() < 5e-7 + 1e-5 * np.ptp(truth[mask])
    assert (height[~mask] == 0.0).all()
