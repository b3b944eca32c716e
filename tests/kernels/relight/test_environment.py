import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import SphericalVoronoi

from kernels.errors import ArrayError
from kernels.relight.environment import integrate_cells, light_weights, nearest_light
from tests.kernels.scenes import cap
from tests.reference import relight as reference
from tests.reference.relight import rotation_about_y, texel_directions, texel_solid_angles

STILL = np.eye(3)[None]
AXES = np.concatenate([np.eye(3), -np.eye(3)])  # +x +y +z -x -y -z
SUM = 1e-12
"""Relative: float64 sums of up to a million samples."""


def sun(rows, cols, row, col, radiance=1.0):
    environment = np.zeros((rows, cols, 3))
    environment[row, col] = radiance
    return environment


@pytest.mark.parametrize("rows, cols", [(90, 180), (64, 128), (720, 1440)])
def test_a_constant_map_sends_each_cell_its_solid_angle(rows, cols, device):
    cells = integrate_cells(np.full((rows, cols, 3), 2.5), cap(50, 180), STILL, device=device)
    np.testing.assert_allclose(cells.energy[0], 2.5 * np.repeat(cells.solid_angle[0][:, None], 3, axis=1), rtol=SUM)
    assert cells.solid_angle.sum() == pytest.approx(texel_solid_angles(rows, cols).sum(), rel=SUM)


def test_cells_are_those_of_spherical_voronoi(device):
    direction = cap(60, 180)
    cells = integrate_cells(np.ones((360, 720, 3)), direction, STILL, device=device)
    areas = SphericalVoronoi(direction).calculate_areas()
    # a border of b radians is drawn with samples of half a degree: each is right on average and off by less than half one;
    # six borders of about 0.5 rad are 340 samples of 7.6e-5 sr, of which the errors add up as the square root
    np.testing.assert_allclose(cells.solid_angle[0], areas, atol=4 * np.sqrt(340) * 7.6e-5 / np.sqrt(12))


@pytest.mark.parametrize("rows, cols", [(7, 14), (16, 32), (30, 20)])
def test_energies_are_those_of_the_twin(rows, cols, device):
    rng = np.random.default_rng(rows)
    environment, direction = rng.gamma(0.3, 5.0, (rows, cols, 3)), cap(17, 150)
    rotations = np.stack([np.eye(3), rotation_about_y(37.0), rotation_about_y(-171.5)])
    cells = integrate_cells(environment, direction, rotations, device=device)
    for frame, rotation in enumerate(rotations):
        down, across = -(-360 // rows), -(-720 // cols)  # half a degree
        energy, solid_angle = reference.cell_energy(environment, direction, rotation, down=down, across=across)
        # a sample on a border may fall to its other side in float32: two of them, of at most half a degree squared
        sample = 2 * np.radians(0.5) ** 2
        np.testing.assert_allclose(cells.solid_angle[frame], solid_angle, atol=sample)
        np.testing.assert_allclose(cells.energy[frame], energy, atol=sample * environment.max())
        total = (environment * texel_solid_angles(rows, cols)[..., None]).sum(axis=(0, 1))
        np.testing.assert_allclose(cells.energy[frame].sum(axis=0), total, rtol=SUM)


@settings(max_examples=25, deadline=None)
@given(data=st.data(), rows=st.integers(1, 400), seed=st.integers(0, 50), spin=st.floats(-360, 360))
def test_a_sun_of_one_texel_is_never_lost(data, rows, seed, spin):
    """Whole whatever its place and size, and where it is: in the cell of its nearest light, unless it lies on a border."""
    cols = 2 * rows
    row, col = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, cols - 1))
    direction = np.random.default_rng(seed).normal(size=(9, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rotation = rotation_about_y(spin)
    cells = integrate_cells(sun(rows, cols, row, col, 1e4), direction, rotation[None], device="cpu")
    whole = 1e4 * texel_solid_angles(rows, cols)[row, col]
    np.testing.assert_allclose(cells.energy[0].sum(axis=0), whole, rtol=SUM)
    angles = np.arccos(np.clip(direction @ rotation @ texel_directions(rows, cols)[row, col], -1, 1))
    nearest, second = np.argsort(angles)[:2]
    if angles[second] - angles[nearest] > 2 * np.pi / rows * 1.01:  # farther from the border than the texel is wide, twice
        np.testing.assert_allclose(cells.energy[0, nearest], whole, rtol=SUM)


@pytest.mark.parametrize("at, light", [((0, 3), 1), ((89, 100), 4), ((45, 90), 2), ((45, 45), 0), ((45, 0), 5), ((45, 179), 5),
                                       ((45, 135), 3)], ids=["top", "bottom", "centre", "left quarter", "left edge", "right edge",
                                                             "right quarter"])
def test_orientation_of_the_contract(at, light, device):
    """Top row +y, centre +z, a quarter from the left +x, the left edge -z."""
    cells = integrate_cells(sun(90, 180, *at), AXES, STILL, device=device)
    assert np.flatnonzero(cells.energy[0, :, 0]).tolist() == [light]


@pytest.mark.parametrize("spin, light", [(0, 2), (90, 0), (180, 5), (270, 3), (-90, 3)])
def test_spin_turns_the_environment_from_z_towards_x(spin, light, device):
    cells = integrate_cells(sun(90, 180, 45, 90), AXES, rotation_about_y(spin)[None], device=device)
    assert np.flatnonzero(cells.energy[0, :, 0]).tolist() == [light]


def test_a_symmetry_of_the_lights_permutes_their_energy(device):
    """Quarter turns about +y of lights that map onto themselves, and of a map whose columns do."""
    environment = np.random.default_rng(3).gamma(0.5, 1.0, (40, 80, 3))
    quarters = [rotation_about_y(90 * q) for q in range(4)]
    off = np.array([[0.48, 0.6, 0.64], [0.8, -0.36, 0.48]])
    direction = np.concatenate([off @ q.T for q in quarters])  # light i of quarter q is at 2 q + i
    cells = integrate_cells(environment, direction, np.stack(quarters), device=device)
    for q in range(4):
        # the environment turned by q quarters gives a light what the light q quarters before it had
        np.testing.assert_allclose(cells.energy[q], np.roll(cells.energy[0], 2 * q, axis=0), rtol=SUM)
        np.testing.assert_allclose(cells.solid_angle[q], np.roll(cells.solid_angle[0], 2 * q), rtol=SUM)


def test_turning_the_map_by_columns_is_spinning_it(device):
    """Rolling the image by n columns turns it by n · 360/W degrees: +z is at the centre, +x to its left."""
    environment, direction = np.random.default_rng(5).random((36, 72, 3)), cap(20, 180)
    rolled = integrate_cells(np.roll(environment, -5, axis=1), direction, STILL, device=device)
    spun = integrate_cells(environment, direction, rotation_about_y(25.0)[None], device=device)
    np.testing.assert_allclose(rolled.energy, spun.energy, rtol=1e-4)  # a few samples on a border fall to its other side
    np.testing.assert_allclose(rolled.energy.sum(axis=1), spun.energy.sum(axis=1), rtol=SUM)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 2, 3), (2, 1, 3), (1, 4096, 3), (2048, 1, 3)])
def test_maps_of_any_shape_are_cut_finely_both_ways(shape, device):
    environment = np.random.default_rng(0).random(shape)
    cells = integrate_cells(environment, AXES, STILL, device=device)
    total = (environment * texel_solid_angles(*shape[:2])[..., None]).sum(axis=(0, 1))
    np.testing.assert_allclose(cells.energy[0].sum(axis=0), total, rtol=SUM)
    if shape[0] == 1:  # one texel reaches from pole to pole: the lights there get their sixth of it, less or more by its share
        np.testing.assert_allclose(cells.solid_angle[0] / cells.solid_angle[0].sum(), np.full(6, 1 / 6), atol=1e-3)


def test_nearest_light_by_brute_force(device):
    direction = cap(31, 180)
    got = nearest_light(37, 75, direction, device=device)
    cosines = texel_directions(37, 75) @ direction.T
    best = cosines.max(axis=-1)
    assert got.shape == (37, 75) and got.dtype == np.int32
    reached = np.take_along_axis(cosines, got[..., None].astype(int), axis=-1)[..., 0]
    np.testing.assert_allclose(reached, best, atol=1e-6)  # float32 cosines: ties to their step
    assert (nearest_light(4, 4, np.repeat(direction[:1], 3, axis=0), device=device) == 0).all()  # of equals the first


@settings(max_examples=15, deadline=None)
@given(count=st.integers(1, 20), seed=st.integers(0, 100))
def test_weights_place_the_whole_energy(count, seed):
    """Σ w E = ∫ L dω in each channel, whatever the lights' colours and the scales of their images."""
    rng = np.random.default_rng(seed)
    environment, irradiance = rng.gamma(0.5, 2.0, (10, 20, 3)), rng.uniform(0.1, 5, (count, 3))
    scale = np.zeros(-(-count // 8) * 8, dtype=np.float32)
    scale[:count] = 2.0 ** rng.integers(-5, 5, count)
    cells = integrate_cells(environment, cap(count, 180), np.stack([np.eye(3), rotation_about_y(77)]), device="cpu")
    weights = light_weights(cells, irradiance, scale)
    assert weights.shape == (2, 3, len(scale)) and weights.dtype == np.float32 and (weights[:, :, count:] == 0).all()
    total = (environment * texel_solid_angles(10, 20)[..., None]).sum(axis=(0, 1))
    placed = np.einsum("fcl,lc,l->fc", weights[:, :, :count].astype(float), irradiance, 1 / scale[:count])
    np.testing.assert_allclose(placed, [total, total], rtol=1e-6)  # float32 weights


def test_a_light_without_a_channel_is_refused():
    cells = integrate_cells(np.ones((4, 8, 3)), AXES, STILL, device="cpu")
    irradiance = np.ones((6, 3))
    irradiance[4, 1] = 0
    with pytest.raises(ArrayError, match="irradiance of light 4 is 0 in channel G"):
        light_weights(cells, irradiance, np.ones(8, dtype=np.float32))


def spotted(value, count):
    environment = np.ones((4, 8, 3))
    environment[0, :count, 1] = value
    return environment


@pytest.mark.parametrize("environment, directions, rotations, message", [
    (np.ones((4, 8)), AXES, STILL, r"environment is \(4, 8\): give \[rows, cols, 3\]"),
    (np.ones((4, 8, 4)), AXES, STILL, r"environment is \(4, 8, 4\)"),
    (np.ones((0, 8, 3)), AXES, STILL, r"environment is \(0, 8, 3\)"),
    (spotted(np.nan, 3), AXES, STILL, "environment has 3 texels that are not finite"),
    (spotted(np.inf, 2), AXES, STILL, "environment has 2 texels that are not finite"),
    (spotted(-1e-3, 5), AXES, STILL, "environment has 5 texels that are negative"),
    (np.ones((4, 8, 3)), AXES[:0], STILL, r"directions are \(0, 3\): give \[lights, 3\], one light or more"),
    (np.ones((4, 8, 3)), AXES[:, :2], STILL, r"directions are \(6, 2\)"),
    (np.ones((4, 8, 3)), AXES * [[1], [1], [2], [1], [1], [1]], STILL, "direction of light 2 is not a unit vector"),
    (np.ones((4, 8, 3)), AXES, np.eye(3), r"rotations are \(3, 3\): give \[frames, 3, 3\]"),
])
def test_bad_arguments_are_refused(environment, directions, rotations, message, device):
    with pytest.raises(ArrayError, match=message):
        integrate_cells(environment, directions, rotations, device=device)
