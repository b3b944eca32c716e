import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from kernels.errors import ArrayError
from kernels.relight.directions.latlong import cut
from kernels.relight.weights.smooth import locate
from service.relight.weights.triangulation import triangulate_sphere
from service.relight.weights.weighting import integrate_smooth
from tests.kernels.relight.lights import AXES, CUBE, STILL, SUM, icosahedron, ring, scattered, sun, turn
from tests.marks import first_short
from tests.reference import relight as reference
from tests.reference.relight import rotation_about, texel_directions, texel_solid_angles
from tests.reference.sampling import lattice

HALF_DEGREE = 360, 720
"""A map whose texels are one sample each."""
SHARE = 2e-6
"""Shares come from float32 distances, of directions in float32, from planes; lights here are 0.1 rad apart or more."""
DOME = np.concatenate([ring(4, 0), [[0, 1, 0]]])
"""+z +x -z -x and +y: nothing below."""
STAGE = np.concatenate([ring(16, e) for e in (-30, 0, 30, 60)] + [[[0, 1, 0]]])
RINGS = np.concatenate([ring(12, e) for e in (-60, -30, 0, 30, 60)] + [[[0, 1, 0], [0, -1, 0]]])


def shares(direction, *, at, device):
    """[lights]: of a sun of half a degree, whole."""
    got = integrate_smooth(sun(*HALF_DEGREE, *at), direction, STILL, device=device).energy[0, :, 1]
    return got / texel_solid_angles(*HALF_DEGREE)[at]


def shares_along(direction, rotation, degrees, *, device):
    """Shares [steps, lights] along a great circle, from +z over -x, turned; and the directions there [steps, 3]."""
    triangles, azimuth = triangulate_sphere(direction), np.pi + np.radians(degrees)
    grid = cut(*HALF_DEGREE)._replace(polar=np.array([np.pi / 2]), azimuth=azimuth)
    face, share = locate(grid, triangles, rotation, device=device)
    got = np.einsum("nk,nkl->nl", share, triangles.share[triangles.corner[face]])
    return got, np.stack([np.sin(azimuth), np.zeros_like(azimuth), -np.cos(azimuth)], axis=1) @ rotation.T


def rotation_onto(a, b):
    """By less than half a turn."""
    return rotation_about(np.cross(a, b), np.degrees(np.arccos(np.clip(a @ b, -1, 1)))) if abs(a @ b) < 1 else np.eye(3) * (a @ b)


@first_short("direction", [AXES, CUBE, icosahedron()], ids=["octahedron", "cube", "icosahedron"])
def test_symmetric_lights_get_equal_parts(direction, device):
    """The cube too, whose squares could be cut along either diagonal."""
    got = integrate_smooth(np.ones((*HALF_DEGREE, 3)), direction, np.stack([np.eye(3), turn(3)]), device=device)
    # of samples of half a degree only those over which a fold of the shares runs are not taken at their mean: an eighth of what the
    # share's slope, below 2 a radian, changes by in them, on folds of less than 4π
    fold = 4 * np.pi * np.radians(0.5) * 2 * np.radians(0.5) / 8
    np.testing.assert_allclose(got.solid_angle, 4 * np.pi / len(direction), atol=fold)


@first_short("at", [(0, 5), (359, 700), (100, 33), (180, 360), (200, 500), (271, 3)])
def test_an_octahedron_shares_by_the_coordinates(at, device):
    """|x|, |y|, |z| over their sum."""
    direction = texel_directions(*HALF_DEGREE)[at]
    expected = np.maximum(np.concatenate([direction, -direction]), 0) / np.abs(direction).sum()
    np.testing.assert_allclose(shares(AXES, at=at, device=device), expected, atol=SHARE)


@pytest.mark.parametrize("seed", range(6))
def test_a_cube_shares_its_squares_by_four_triangles(seed, device):
    """Where the ray meets the square x = 1, at (y, z) with 0 ≤ y ≤ z, the triangle is that of the middle and two corners."""
    z, y = np.sort(np.abs(scattered(1, seed)[0][:2]))[::-1]
    expected = np.zeros(8)
    expected[4:] = (1 - z) / 4  # (1, ±1, ±1): -- -+ +- ++
    expected[7] += (z + y) / 2
    expected[5] += (z - y) / 2
    rotation = rotation_onto(np.array([0, 0, 1]), np.array([1, y, z]) / np.sqrt(1 + y * y + z * z))
    np.testing.assert_allclose(shares_along(CUBE, rotation, np.zeros(1), device=device)[0][0], expected, atol=SHARE)


@first_short("at", [(40, 100), (180, 200), (250, 100), (300, 500), (359, 0)])
def test_what_comes_from_below_a_dome_goes_to_its_rim(at, device):
    """As if there were a light at -y, whose share goes to the four on the horizon."""
    x, y, z = texel_directions(*HALF_DEGREE)[at]
    expected = np.array([max(z, 0), max(x, 0), max(-z, 0), max(-x, 0), max(y, 0)])
    expected[:4] += max(-y, 0) / 4
    np.testing.assert_allclose(shares(DOME, at=at, device=device), expected / (abs(x) + abs(y) + abs(z)), atol=SHARE)


@pytest.mark.parametrize("direction", [lattice(60, 180), scattered(40, 7), STAGE, lattice(96, 90), lattice(331, 60)],
                         ids=["even", "any", "rings", "half", "front"])
def test_a_sun_at_a_light_is_its_own(direction, device):
    for light in range(0, len(direction), 7):
        share, _ = shares_along(direction, rotation_onto(np.array([0, 0, 1.0]), direction[light]), np.zeros(1), device=device)
        # float32 directions to 1e-7, among lights 0.05 rad apart or more
        np.testing.assert_allclose(share[0], np.arange(len(direction)) == light, atol=1e-5)


@first_short("direction", [icosahedron(), lattice(60, 180), scattered(80, 2), CUBE, RINGS],
             ids=["icosahedron", "even", "any", "cube", "rings"])
def test_shares_reproduce_the_direction(direction, device):
    """Σ share · light points at the sun, within a polygon too, because its imaginary light is in the middle of its corners."""
    for seed in range(20):
        share, place = shares_along(direction, turn(seed), np.arange(0, 360, 0.1), device=device)
        got = share @ direction
        np.testing.assert_allclose(got / np.linalg.norm(got, axis=1, keepdims=True), place, atol=SHARE)


@pytest.mark.long
@pytest.mark.parametrize("rows, cols, seed", [(7, 14, None), (16, 32, 1), (360, 720, 2)])
def test_energies_are_those_of_the_twin(rows, cols, seed, device):
    """With the same samples, triangles by trying all threes of lights, and shares by inversion."""
    environment, direction = np.random.default_rng(rows).gamma(0.3, 5.0, (rows, cols, 3)), scattered(16, 28)
    assert len(triangulate_sphere(direction).vertex) == 16  # no imaginary lights, which the twin does not know
    rotation = np.eye(3) if seed is None else turn(seed)
    got = integrate_smooth(environment, direction, rotation[None], device=device)
    energy, solid_angle = reference.smooth_energy(environment, direction, rotation, down=-(-360 // rows), across=-(-720 // cols))
    np.testing.assert_allclose(got.solid_angle[0], solid_angle, rtol=SHARE)
    np.testing.assert_allclose(got.energy[0], energy, rtol=SHARE)


@pytest.mark.long
@settings(max_examples=40, deadline=None)
@given(data=st.data(), rows=st.integers(1, 400), seed=st.integers(0, 1000), count=st.integers(4, 30), axis=st.integers(0, 1000),
       spread=st.sampled_from([0.02, 0.3, 2.0, None]))
def test_a_sun_of_one_texel_is_never_lost(data, rows, seed, count, axis, spread):
    """Whole whatever its place and size, the turn and the lights, also on one side only or close together; never less than nothing."""
    cols = 2 * rows
    row, col = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, cols - 1))
    direction = scattered(count, seed)
    if spread is not None:
        direction = direction * spread + [0, 0, 1]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    assume(np.linalg.svd(direction - direction.mean(axis=0))[1][2] > 0.01)
    got = integrate_smooth(sun(rows, cols, row, col, 1e4), direction, turn(axis)[None], device="cpu")
    assert got.energy.min() >= 0 and got.solid_angle.min() >= 0
    np.testing.assert_allclose(got.energy[0].sum(axis=0), 1e4 * texel_solid_angles(rows, cols)[row, col], rtol=SUM)


@pytest.mark.long
@pytest.mark.parametrize("direction", [DOME, STAGE, RINGS, lattice(96, 90), lattice(331, 60), scattered(50, 3), lattice(4, 50),
                                       lattice(50, 20)], ids=["dome", "stage", "rings", "half", "front", "any", "four in front", "narrow"])
def test_a_sun_moves_without_a_jump_also_where_lights_are_missing(direction, device):
    """Steps a tenth as wide change the shares a tenth as much, or a little more at folds; a jump would stay."""
    for seed in range(4):
        coarse, fine = (np.abs(np.diff(shares_along(direction, turn(seed), np.arange(0, 360, step), device=device)[0], axis=0)).max()
                        for step in (0.1, 0.01))
        assert fine < 0.2 * coarse


def test_of_lights_in_one_place_the_first_gets_all(device):
    direction = np.repeat(CUBE, 3, axis=0) + [[0, 0, 0], [1e-6, 0, 0], [0, 1e-6, 0]] * 8
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    got = integrate_smooth(np.ones((90, 180, 3)), direction, STILL, device=device)
    single = integrate_smooth(np.ones((90, 180, 3)), CUBE, STILL, device=device)
    np.testing.assert_allclose(got.energy[0, ::3], single.energy[0], rtol=SUM)
    assert (np.delete(got.energy[0], np.s_[::3], axis=0) == 0).all()


@pytest.mark.parametrize("direction, message", [
    (AXES[:1], "needs lights in four different places, got 1: choose cells"),
    (AXES[:3], "lights in four different places, got 3"),
    (np.repeat(AXES[:3], 4, axis=0), "lights in four different places, got 3"),
    (ring(12, 0), "lights that are not all in one plane, got 12 that are"),
    (ring(5, 60), "not all in one plane, got 5 that are"),
])
def test_lights_that_enclose_nothing_are_refused(direction, message, device):
    with pytest.raises(ArrayError, match=message):
        integrate_smooth(np.ones((4, 8, 3)), direction, STILL, device=device)
