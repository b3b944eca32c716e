import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import SphericalVoronoi

from kernels.relight.directions.latlong import cut
from kernels.relight.weights.cells import integrate_cells, nearest_light
from tests.kernels.relight.lights import AXES, CUBE, STILL, SUM, dodecahedron, icosahedron, ring, scattered, sun, turn
from tests.marks import first_short
from tests.reference import relight as reference
from tests.reference.relight import rotation_about, rotation_about_y, texel_directions, texel_solid_angles
from tests.reference.sampling import lattice

HALF_DEGREE = 360, 720
"""A map whose texels are one sample each."""
MIDPOINT = (np.pi / 360) ** 2 / 24
"""Relative, by which the contract's solid angle of a half-degree texel, that of its middle times its sides, is too large."""
FLAT = 3e-5
"""Of a sample, by which parts of half a degree are off when it is taken as flat: 1 - cos³ of its reach of 0.35 degrees."""
BEND = np.radians(0.25) ** 2 / 12
"""Radians, 1.6e-6, by which the parallels at a sample's top and bottom are off in the mean when they are taken as straight, and so the
borders of cells: a third of a² sin θ cos θ / 2, where a is half its azimuth."""


@pytest.mark.parametrize("rows, cols", [(90, 180), (64, 128), (720, 1440)])
def test_a_constant_map_sends_each_cell_its_solid_angle(rows, cols, device):
    cells = integrate_cells(np.full((rows, cols, 3), 2.5), lattice(50, 180), STILL, device=device)
    np.testing.assert_allclose(cells.energy[0], 2.5 * np.repeat(cells.solid_angle[0][:, None], 3, axis=1), rtol=SUM)
    assert cells.solid_angle.sum() == pytest.approx(texel_solid_angles(rows, cols).sum(), rel=SUM)


@pytest.mark.parametrize("direction", [lattice(20, 180), lattice(96, 180), lattice(331, 180), scattered(20, 1), scattered(96, 2),
                                       scattered(331, 3), lattice(60, 90)],
                         ids=["20", "96", "331", "any 20", "any 96", "any 331", "half the sphere"])
def test_cells_are_the_polygons_of_spherical_voronoi(direction, device):
    """Exact polygons by SciPy."""
    cells = integrate_cells(np.ones((*HALF_DEGREE, 3)), direction, STILL, device=device)
    areas = SphericalVoronoi(direction).calculate_areas() * (1 + MIDPOINT)
    # the border of a polygon is longer than that of a cap, √(A (4π - A)), by less than half
    assert (np.abs(cells.solid_angle[0] - areas) < BEND * 1.5 * np.sqrt(areas * (4 * np.pi - areas))).all()


@pytest.mark.long
@pytest.mark.parametrize("direction", [AXES, CUBE, icosahedron(), dodecahedron(), ring(2, 0), ring(40, 0)],
                         ids=["octahedron", "cube", "icosahedron", "dodecahedron", "halves", "40 lunes"])
@pytest.mark.parametrize("seed", [None, 0])
def test_symmetric_lights_have_equal_cells(direction, seed, device):
    """However the map is turned; of the lunes 40 meet in one sample."""
    rotations = STILL if seed is None else turn(seed)[None]
    cells = integrate_cells(np.ones((*HALF_DEGREE, 3)), direction, rotations, device=device)
    equal = 4 * np.pi / len(direction) * (1 + MIDPOINT)
    # borders are 2π long at the most, and at the ends of the lunes parts of a 32nd of a degree go whole to one of them
    np.testing.assert_allclose(cells.solid_angle[0], equal, atol=BEND * 2 * np.pi + 4 * np.radians(1 / 32) ** 2)


@pytest.mark.long
@pytest.mark.parametrize("rows, cols, seed", [(7, 14, None), (16, 32, 1), (30, 20, 2)])
def test_energies_are_those_of_the_twin(rows, cols, seed, device):
    """Which sends whole samples of a sixth of a degree or less to the nearest light."""
    environment, direction = np.random.default_rng(rows).gamma(0.3, 5.0, (rows, cols, 3)), lattice(17, 150)
    rotation = np.eye(3) if seed is None else turn(seed)
    cells = integrate_cells(environment, direction, rotation[None], device=device)
    down, across = -(-1080 // rows), -(-2160 // cols)
    energy, solid_angle = reference.cell_energy(environment, direction, rotation, down=down, across=across)
    # the twin's samples on a border are right on average and off by less than half one: six borders of about 0.6 rad are 1200
    # samples of 8.5e-6 sr, of which the errors add up as the square root
    border = 4 * np.sqrt(1200 / 12) * np.radians(1 / 6) ** 2
    np.testing.assert_allclose(cells.solid_angle[0], solid_angle, atol=border)
    np.testing.assert_allclose(cells.energy[0], energy, atol=border * environment.max())
    total = (environment * texel_solid_angles(rows, cols)[..., None]).sum(axis=(0, 1))
    np.testing.assert_allclose(cells.energy[0].sum(axis=0), total, rtol=SUM)


@pytest.mark.long
@settings(max_examples=40, deadline=None)
@given(data=st.data(), rows=st.integers(1, 400), seed=st.integers(0, 50), count=st.integers(1, 30), axis=st.integers(0, 1000))
def test_a_sun_of_one_texel_is_never_lost(data, rows, seed, count, axis):
    """Whole whatever its place and size and the turn, and where it is: in the cell of its nearest light, unless on a border."""
    cols = 2 * rows
    row, col = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, cols - 1))
    direction, rotation = scattered(count, seed), turn(axis)
    cells = integrate_cells(sun(rows, cols, row, col, 1e4), direction, rotation[None], device="cpu")
    whole = 1e4 * texel_solid_angles(rows, cols)[row, col]
    assert cells.energy.min() >= 0
    np.testing.assert_allclose(cells.energy[0].sum(axis=0), whole, rtol=SUM)
    angles = np.arccos(np.clip(direction @ rotation @ texel_directions(rows, cols)[row, col], -1, 1))
    nearest, second = np.argsort(np.append(angles, 4.0))[:2]
    if count == 1 or angles[second] - angles[nearest] > 2 * np.pi / rows * 1.01:  # farther from the border than the texel is wide, twice
        np.testing.assert_allclose(cells.energy[0, nearest], whole, rtol=SUM)


def test_a_sun_moves_over_a_border_in_proportion(device):
    """A texel of half a degree from one half of the sphere to the other, a tenth of a degree a frame: over a meridian and, at right
    angles to it, over the equator."""
    steps = np.arange(-6, 7) / 10
    for axis, lights, at in (((0, 1, 0), AXES[[0, 3]], (180, 360)), ((1, 0, 0), AXES[[1, 4]], (180, 360))):
        environment = sun(*HALF_DEGREE, *at)  # its middle is a quarter of a degree right of and below +z
        rotations = np.stack([rotation_about(axis, degrees) for degrees in steps])
        cells = integrate_cells(environment, lights, rotations, device=device)
        share = cells.energy[:, 0, 0] / cells.energy[0, :, 0].sum()
        # +y turns +z towards +x, where light 0 is, but the texel is on -x: the left of the map is +x; +x turns +z towards -y
        expected = np.clip(steps / 0.5 if axis[1] else -steps / 0.5, 0, 1)
        np.testing.assert_allclose(share, expected, atol=FLAT + 1e-12)


def test_a_sun_moves_over_a_slanting_border_without_a_jump(device):
    """The border cuts the square texel from corner to corner, and beyond: a piece is half the square of its height."""
    steps = np.arange(-6, 7) / 10
    lights = np.array([[1, 1, 0], [-1, -1, 0]]) / np.sqrt(2)
    middle = texel_directions(*HALF_DEGREE)[180, 360]
    to_border = np.degrees(np.arcsin(lights[0] @ middle))
    axis = np.cross(middle, lights[0])
    rotations = np.stack([rotation_about(axis, degrees - to_border) for degrees in steps])
    cells = integrate_cells(sun(*HALF_DEGREE, 180, 360), lights, rotations, device=device)
    share = cells.energy[:, 0, 0] / cells.energy[0, :, 0].sum()
    diagonal = 0.5 / np.sqrt(2)
    corner = np.maximum(diagonal - np.abs(steps), 0) ** 2 / 0.5**2
    # at a quarter of a degree from the equator the texel is 1e-5 narrower than high; its corner is off the axis by as little
    np.testing.assert_allclose(share, np.where(steps > 0, 1 - corner, corner), atol=FLAT + 2e-5)


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


@first_short("seed", range(4))
def test_turning_a_map_about_any_axis_is_turning_the_lights_back(seed, device):
    """A map that brightens along an axis, turned in closed form."""
    direction, rotation = lattice(40, 180), turn(seed)
    axis, middles = np.array([0.6, 0.0, 0.8]), texel_directions(*HALF_DEGREE)
    still, turned = (np.repeat(1 + (middles @ a)[..., None], 3, axis=2) for a in (axis, rotation @ axis))
    spun = integrate_cells(still, direction, rotation[None], device=device)
    drawn = integrate_cells(turned, direction, STILL, device=device)
    back = integrate_cells(still, direction @ rotation, STILL, device=device)
    np.testing.assert_allclose(spun.energy, back.energy, rtol=SUM)
    # the map is taken as even over half a degree, of which it changes by 0.009 at most: parts on the border see half of that wrong
    border = 2 * np.pi * np.radians(0.5) * 0.009 / 2
    np.testing.assert_allclose(spun.energy, drawn.energy, atol=border / 10)  # with either sign, over a hundred samples


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 2, 3), (2, 1, 3), (1, 4096, 3), (2048, 1, 3)])
def test_maps_of_any_shape_are_cut_finely_both_ways(shape, device):
    environment = np.random.default_rng(0).random(shape)
    cells = integrate_cells(environment, AXES, STILL, device=device)
    total = (environment * texel_solid_angles(*shape[:2])[..., None]).sum(axis=(0, 1))
    np.testing.assert_allclose(cells.energy[0].sum(axis=0), total, rtol=SUM)
    if shape[0] == 1:  # one texel reaches from pole to pole: the lights there get their sixth of it
        np.testing.assert_allclose(cells.solid_angle[0] / cells.solid_angle[0].sum(), np.full(6, 1 / 6), rtol=FLAT)


def test_a_map_of_several_bands(device, monkeypatch):
    environment, direction = np.random.default_rng(8).random((30, 60, 3)), lattice(25, 180)
    whole = integrate_cells(environment, direction, turn(1)[None], device=device)
    monkeypatch.setattr("kernels.relight.directions.latlong.BAND_SAMPLES", 5000)
    np.testing.assert_allclose(integrate_cells(environment, direction, turn(1)[None], device=device).energy, whole.energy, rtol=SUM)


def test_of_lights_in_one_place_the_first_has_the_cell(device):
    direction = np.repeat(AXES, 3, axis=0) + [[0, 0, 0], [1e-6, 0, 0], [0, 1e-6, 0]] * 6
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    cells = integrate_cells(np.ones((90, 180, 3)), direction, turn(2)[None], device=device)
    single = integrate_cells(np.ones((90, 180, 3)), AXES, turn(2)[None], device=device)
    np.testing.assert_allclose(cells.energy[0, ::3], single.energy[0], rtol=SUM)
    assert (np.delete(cells.energy[0], np.s_[::3], axis=0) == 0).all()


@first_short("direction", [lattice(31, 180), AXES, ring(40, 0), scattered(100, 5), AXES[:1]], ids=["31", "axes", "lunes", "100", "one"])
def test_nearest_light_by_brute_force(direction, device):
    whole = cut(37, 75)
    grid = whole._replace(**{name: getattr(whole, name)[3::7] for name in ("polar", "solid_angle", "texel_row")})
    got = nearest_light(grid, direction, device=device)
    middles = texel_directions(len(whole.polar), len(whole.azimuth))[3::7]
    cosines = middles @ direction.T
    assert got.light.shape == middles.shape[:2] and got.light.dtype == np.int32
    reached = np.take_along_axis(cosines, got.light[..., None].astype(int), axis=-1)[..., 0]
    np.testing.assert_allclose(reached, cosines.max(axis=-1), atol=1e-6)  # float32 cosines: ties to their step
    # no border comes nearer to the middle of a sample that is not marked than its corners are
    apart = np.linalg.norm(direction[got.light][:, :, None] - direction, axis=-1)
    distance = np.where(apart > 0, (reached[..., None] - cosines) / np.maximum(apart, 1e-9), np.inf).min(axis=-1)
    corner = np.hypot(grid.half_polar, grid.half_azimuth * np.sin(grid.polar))
    assert (distance > corner[:, None] * (1 - 1e-4))[~got.crossed].all()
    assert not got.crossed.all()
