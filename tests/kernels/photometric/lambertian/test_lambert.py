
import numpy as np
import pytest

from kernels import packs
from kernels.errors import ArrayError
from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.readings import grey_readings
from kernels.photometric.lambertian.robust import solve_robust
from kernels.status import Status
from tests.kernels.scenes import GREY, angle_degrees, colours, rounding_bounds, shade, solve
from tests.reference import photometric as reference
from tests.reference.sampling import lattice

PIXEL_COUNTS = [1, 31, 33, 513]
FLOAT32_DEGREES = 1e-4
"""Float32 sums of tens of lights leave 1e-6 of b: 6e-5 degrees."""
both = pytest.mark.parametrize("solver", [solve_lambert, solve_robust])


def ball(count, lights, largest=75.0):
    normal = lattice(count, 80)
    return normal, colours(count), lattice(lights, largest), 3 * colours(lights, seed=1)


def check_exact(solved, normal, albedo, direction, irradiance):
    """Every pixel is solved, and off by no more than half rounding explains."""
    assert (solved.status == Status.OK).all()
    angle, relative = rounding_bounds(normal, albedo, direction, irradiance, solved.weights > 0)
    assert (angle_degrees(solved.normal, normal) <= angle + FLOAT32_DEGREES).all()
    assert (np.abs(solved.albedo / albedo - 1) <= relative[:, None] + 1e-5).all()  # float32 sums


@pytest.mark.parametrize("pixels", PIXEL_COUNTS)
def test_lambertian_ball(pixels, device):
    normal, albedo, direction, irradiance = ball(pixels, 27)
    solved = solve(solve_lambert, shade(normal, albedo, direction, irradiance), direction, irradiance, device)
    check_exact(solved, normal, albedo, direction, irradiance)
    np.testing.assert_allclose(np.linalg.norm(solved.normal, axis=1), 1, atol=1e-6)  # float32
    # a least-squares residual is at most that of the truth, half rounding of every reading; reached through the
    # difference of sums of squares in float32: 1e-6 of them, 1e-3 of their root
    assert (solved.residual < 2.0**-11 + 1e-3).all()


def test_three_lights_determine_the_normal_exactly(device):
    direction = lattice(3, 40)
    normal, albedo = lattice(64, 30), colours(64)  # every light above every horizon
    irradiance = 2 * colours(3, seed=3)
    solved = solve(solve_lambert, shade(normal, albedo, direction, irradiance), direction, irradiance, device)
    check_exact(solved, normal, albedo, direction, irradiance)
    assert (solved.freedom == 0).all()
    assert (solved.sigma() > 2.3).all()  # no residual is left, and nothing that could tell a wrong normal


def test_values_are_those_of_the_twin_on_noisy_data(device):
    normal, albedo, direction, irradiance = ball(300, 21, 100)
    rng = np.random.default_rng(5)
    radiance = shade(normal, albedo, direction, irradiance)
    radiance = (radiance * rng.normal(1, 0.05, radiance.shape) + rng.normal(0, 0.01, radiance.shape)).astype(np.float16)
    solved = solve(solve_lambert, radiance, direction, irradiance, device)
    readings = reference.grey_readings(radiance.astype(float), irradiance, GREY)
    fit = reference.solve_lambert(readings, direction)
    assert [Status(s).name for s in solved.status] == list(fit.status)
    ok = fit.status == "OK"
    np.testing.assert_array_equal(solved.weights, readings > 0)
    np.testing.assert_allclose(solved.normal[ok], fit.normal[ok], atol=1e-5)  # float32 normal equations
    np.testing.assert_allclose(solved.residual[ok], fit.residual[ok], atol=1e-4)  # the cancelling difference of squares
    for name in ("across", "squares", "freedom", "spare", "agreeing"):  # float32, and the difference of squares
        np.testing.assert_allclose(getattr(solved, name)[ok], getattr(fit, name)[ok], rtol=1e-3, atol=1e-4, err_msg=name)
    expected = reference.albedo(radiance.astype(float), fit.normal, direction, irradiance, fit.weights)
    np.testing.assert_allclose(solved.albedo, expected, atol=1e-4)


def test_pixels_with_every_reading_are_solved_alike_beside_one_that_lacks_some(device):
    """The products of the lights are summed once for packs whose pixels have every reading. To float32 sums, and their difference."""
    normal, albedo, direction, irradiance = lattice(320, 30), colours(320), lattice(19, 40), 3 * colours(19, seed=1)
    radiance = shade(normal, albedo, direction, irradiance)
    radiance *= np.random.default_rng(2).normal(1, 0.03, radiance.shape)
    whole = solve(solve_lambert, radiance, direction, irradiance, device)
    assert (whole.weights[:19] == 1).all() and (whole.status == Status.OK).all()
    lacking = np.arange(0, 320, 4)  # one in every pack
    radiance[:, 5, lacking] = 0
    part = solve(solve_lambert, radiance, direction, irradiance, device)
    kept = np.setdiff1d(np.arange(320), lacking)
    assert (part.weights[5, lacking] == 0).all() and (part.weights[:19, kept] == 1).all()
    np.testing.assert_allclose(part.normal[kept], whole.normal[kept], atol=2e-6)
    np.testing.assert_allclose(part.squares[kept], whole.squares[kept], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(part.across[kept], whole.across[kept], rtol=1e-5)
    assert np.abs(part.normal[lacking] - whole.normal[lacking]).max() > 1e-3


@both
@pytest.mark.parametrize("lit, status", [(0, Status.DARK), (1, Status.TOO_FEW_LIGHTS), (2, Status.TOO_FEW_LIGHTS), (3, Status.OK),
                                         (9, Status.OK)])
def test_status_by_the_number_of_readings(solver, lit, status, device):
    direction = lattice(12, 30)
    radiance = np.zeros((3, 12, 1))
    radiance[:, :lit] = direction[:lit, 2][None, :, None]  # faces +z
    solved = solve(solver, radiance, direction, np.ones((12, 3)), device)
    assert solved.status[0] == status
    if status == Status.OK:
        assert angle_degrees(solved.normal, np.array([[0, 0, 1]]))[0] < 0.3  # half rounding; lights within 30 degrees multiply it
    else:
        for name, values in solved._asdict().items():
            assert (values == 0).all() or name == "status" or (solver, name) == (solve_lambert, "weights"), name


def circle(count, off_degrees, seed=0):
    """Lights off a tilted great circle by up to so many degrees."""
    rng = np.random.default_rng(seed)
    along, off = np.linspace(-1.2, 1.2, count), np.radians(off_degrees) * rng.uniform(-1, 1, count)
    flat = np.stack([np.cos(off) * np.sin(along), np.sin(off), np.cos(off) * np.cos(along)], axis=1)
    tilt = np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]])
    return flat @ tilt.T


@both
@pytest.mark.parametrize("direction, status", [
    (lattice(12, 0.5), Status.ILL_POSED), (lattice(300, 1.0), Status.ILL_POSED), (lattice(12, 3.0), Status.OK),
    (circle(3, 0), Status.ILL_POSED), (circle(1000, 0), Status.ILL_POSED), (circle(40, 0.3), Status.ILL_POSED),
    (circle(40, 3), Status.OK),
], ids=["half a degree", "one degree", "three degrees", "3 coplanar", "1000 coplanar", "band of 0.3", "band of 3"])
def test_lights_near_a_point_or_a_plane(solver, direction, status, device):
    irradiance = np.ones((len(direction), 3))
    radiance = shade(np.array([[0.0, 0.0, 1.0]]), np.ones((1, 3)), direction, irradiance)
    solved = solve(solver, radiance, direction, irradiance, device)
    assert solved.status[0] == status
    assert (np.abs(solved.normal).sum() > 0) == (status == Status.OK)
    assert solver is solve_lambert or (solved.weights > 0).any() == (status == Status.OK)


def test_the_same_from_every_side_has_no_direction(device):
    direction = np.concatenate([np.eye(3), -np.eye(3)])
    solved = solve(solve_lambert, np.ones((3, 6, 1)), direction, np.ones((6, 3)), device)
    assert solved.status[0] == Status.ILL_POSED
    assert np.isfinite(solved.residual).all() and np.isfinite(solved.squares).all()


@pytest.mark.parametrize("garbage", [60000.0, np.inf, np.nan])
def test_saturated_readings_do_not_matter(garbage, device):
    normal, albedo, direction, irradiance = ball(100, 20)
    radiance = shade(normal, albedo, direction, irradiance)
    saturated = np.random.default_rng(2).random((20, 100)) < 0.25
    clean = solve(solve_lambert, np.where(saturated, 0, radiance), direction, irradiance, device)
    dirty = solve(solve_lambert, np.where(saturated, garbage, radiance), direction, irradiance, device, saturated=saturated)
    for name, values in clean._asdict().items():
        np.testing.assert_array_equal(getattr(dirty, name), values, err_msg=name)


@both
def test_nothing_is_nan_whatever_the_input(solver, device):
    rng = np.random.default_rng(7)
    values = np.array([np.nan, np.inf, -np.inf, -1, 0, 1e-7, 6e-5, 1, 65504])
    radiance = rng.choice(values, size=(3, 20, 3000), p=[0.02, 0.02, 0.02, 0.04, 0.4, 0.1, 0.1, 0.2, 0.1])
    radiance[:, :, :1000] = rng.choice([0.0, 1.0], size=(1, 20, 1000))  # ties alone
    radiance[:, 2:, :10] = 0
    solved = solve(solver, radiance, lattice(20, 180), np.ones((20, 3)), device)
    assert set(solved.status) >= {Status.OK, Status.TOO_FEW_LIGHTS}
    for name, out in solved._asdict().items():
        assert np.isfinite(out).all(), name
    ok = solved.status == Status.OK
    assert (solved.normal[~ok] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(solved.normal[ok], axis=1), 1, atol=1e-6)  # float32
    assert solver is solve_lambert or ((solved.weights >= 0) & (solved.weights <= 1)).all()


def test_directions_of_another_capture_are_refused(device):
    band = packs.upload(np.zeros((3, 8, 4), dtype=np.float16), device=device)
    readings = grey_readings(band, np.zeros((8, 3), dtype=np.float32))
    with pytest.raises(ArrayError, match=r"directions are \(16, 3\), the band has 8 lights: give a row"):
        solve_lambert(band, readings, np.zeros((16, 3), dtype=np.float32))
