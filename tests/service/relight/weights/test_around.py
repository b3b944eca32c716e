"""The lights around a direction, and around each light when it is left out, against brute force and symmetry."""

import itertools

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from service.relight.weights.triangulation import left_out, lights_around
from tests.kernels.relight.lights import AXES, CUBE, dodecahedron, icosahedron, ring, scattered, turn
from tests.reference.relight import shares_among
from tests.reference.sampling import lattice


def geodesic():
    """The corners of an icosahedron and the middles of its edges."""
    corners = icosahedron()
    beside = np.argwhere(np.triu(corners @ corners.T, 1) > 0.4)
    middles = corners[beside].sum(axis=1)
    return np.concatenate([corners, middles / np.linalg.norm(middles, axis=1, keepdims=True)])


DOME = geodesic() @ turn(2).T
DOME = DOME[DOME[:, 2] > -0.1]
"""Triangles everywhere above, nothing below."""
ROUND = {"octahedron": AXES, "icosahedron": icosahedron(), "geodesic": geodesic(), "even": lattice(20, 180), "any": scattered(20, 13),
         "turned": icosahedron() @ turn(1).T}
"""All around, in triangles that no four lights make a polygon of: without imaginary lights."""
LAYOUTS = {**ROUND, "cube": CUBE, "dodecahedron": dodecahedron(), "dome": DOME, "tetrahedron": CUBE[[0, 3, 5, 6]],
           "rings": np.concatenate([AXES[[1, 4]], *(ring(12, e) for e in (-60, -30, 0, 30, 60))]), "front": lattice(40, 50),
           "many": lattice(200, 180), "half": lattice(96, 90), "scattered": scattered(60, 4), "twice": np.repeat(icosahedron(), 2, axis=0),
           "horizon": np.concatenate([ring(16, 0), ring(8, 45), [[0, 1, 0]]])}
LAYOUT = pytest.mark.parametrize("direction", LAYOUTS.values(), ids=LAYOUTS)
SHARE = 2e-7
"""Float32 shares, of places that triangulating shifts by 1e-10."""


def weighted(direction, around, share):
    """[n, lights]"""
    whole = np.zeros((len(around), len(direction)))
    for k in range(3):
        np.add.at(whole, (np.arange(len(around)), around[:, k]), share[:, k])
    return whole


@LAYOUT
def test_shares_are_parts_of_one(direction):
    around, share = lights_around(direction, scattered(5000, 0))
    assert around.dtype == np.int32 and share.dtype == np.float32 and around.shape == share.shape == (5000, 3)
    assert around.min() >= 0 and around.max() < len(direction) and share.min() >= 0
    np.testing.assert_allclose(share.sum(axis=1), 1, atol=SHARE)


@pytest.mark.parametrize("direction", ROUND.values(), ids=ROUND)
def test_shares_are_those_of_the_delaunay_triangle(direction):
    samples = scattered(500, 1)
    got = weighted(direction, *lights_around(direction, samples))
    np.testing.assert_allclose(got, shares_among(direction)(samples), atol=SHARE)


def test_inside_a_dome_too():
    """Tolerance: float32 shares, over a sum of corners no shorter than a fifth."""
    samples = scattered(5000, 3)
    samples = samples[samples[:, 2] > 0.35]  # its rim lies below
    around, share = lights_around(DOME, samples)
    sums = np.einsum("nk,nkx->nx", share.astype(float), DOME[around])
    np.testing.assert_allclose(sums / np.linalg.norm(sums, axis=1, keepdims=True), samples, atol=1e-6)


@LAYOUT
def test_a_light_is_around_itself(direction):
    """The first of those in one place."""
    got = weighted(direction, *lights_around(direction, direction))
    first = [int(np.flatnonzero(direction @ d > 1 - 1e-9)[0]) for d in direction]
    np.testing.assert_allclose(got, np.eye(len(direction))[first], atol=SHARE)


def test_in_a_square_the_nearest_stands_for_its_middle():
    """Of a cube: where a side's middle has no light, one of its corners has its share, and all corners of a sample are of that side."""
    samples = scattered(2000, 5)
    around, share = lights_around(CUBE, samples)
    side = np.abs(samples).argmax(axis=1)
    sign = np.sign(samples[np.arange(2000), side])
    assert (np.sign(CUBE[around, side[:, None]]) == sign[:, None])[share > 1e-6].all()


def test_below_a_dome_are_lights_of_its_rim():
    """Not those in its middle, though the hull's faces below would have some."""
    around, share = lights_around(DOME, np.array([[0.1, 0.2, -0.97], [0, 0, -1.0]]) / [[np.linalg.norm([0.1, 0.2, -0.97])], [1]])
    assert (DOME[around, 2][share > 0] < 0.35).all()


def test_many_samples_are_their_parts():
    samples = scattered(9001, 1)
    around, share = lights_around(lattice(30, 180), samples)
    for start in (0, 4000, 8990):
        some = lights_around(lattice(30, 180), samples[start : start + 11])
        np.testing.assert_array_equal(around[start : start + 11], some[0])
        np.testing.assert_allclose(share[start : start + 11], some[1], atol=SHARE)


@LAYOUT
def test_a_light_is_left_out_of_its_own_prediction(direction):
    lights, share = left_out(direction)
    assert lights.dtype == np.int32 and share.dtype == np.float32 and lights.shape == share.shape == (len(direction), 3)
    assert lights.min() >= 0 and lights.max() < len(direction) and share.min() >= 0
    total = share.sum(axis=1)
    held = total > 0
    np.testing.assert_allclose(total[held], 1, atol=SHARE)
    assert (direction[lights[held]] @ direction[held][:, :, None] < 1 - 1e-9).all()  # nor another in its place


@LAYOUT
def test_a_prediction_points_along_the_light(direction):
    lights, share = left_out(direction)
    held = share.sum(axis=1) > 0
    sums = np.einsum("nk,nkx->nx", share.astype(float), direction[lights])[held]
    # a share may be 1e-6 below none, and is held at none
    np.testing.assert_allclose(sums / np.linalg.norm(sums, axis=1, keepdims=True), direction[held], atol=1e-5)


@pytest.mark.parametrize("direction", ROUND.values(), ids=ROUND)
def test_the_nearest_neighbours_predict_it(direction):
    """Brute force over triples of those that share an edge of the hull with it."""
    lights, share = left_out(direction)
    beside = [set() for _ in direction]
    for a, b, c in ConvexHull(direction).simplices.tolist():
        for one, other in itertools.permutations((a, b, c), 2):
            beside[one].add(other)
    for light, ring_of in enumerate(beside):
        near = {}
        for triple in itertools.combinations(sorted(ring_of), 3):
            corners = direction[list(triple)].T
            if abs(np.linalg.det(corners)) > 1e-6 and np.linalg.solve(corners, direction[light]).min() > -1e-7:
                near[triple] = (direction[light] @ corners).min()
        if not near:
            assert share[light].sum() == 0
            continue
        assert (direction[light] @ direction[lights[light]].T).min() == pytest.approx(max(near.values()), abs=1e-12)
        assert set(lights[light].tolist()) <= ring_of


def test_a_light_between_its_neighbours_is_predicted_and_one_at_the_rim_is_not():
    lights, share = left_out(DOME)
    inside = DOME[:, 2] > 0.6
    assert (share[inside].sum(axis=1) > 0.99).all()
    assert share[DOME[:, 2].argmin()].sum() == 0  # nothing below it
    assert (DOME[lights] * DOME[:, None]).sum(axis=2)[inside].min() > np.cos(np.radians(37))  # those beside it, at most 36 degrees away


def test_opposite_lights_of_a_ring_are_halved():
    """One of 16 lights on the horizon lies between the two beside it; what is above and below gives nothing."""
    direction = np.concatenate([ring(16, 0), ring(8, 50), ring(8, -50), [[0, 1, 0], [0, -1, 0]]])
    lights, share = left_out(direction)
    for light in range(16):
        got = dict(zip(lights[light].tolist(), share[light].tolist(), strict=True))
        assert got[(light + 1) % 16] == pytest.approx(0.5, abs=1e-6) and got[(light - 1) % 16] == pytest.approx(0.5, abs=1e-6)
