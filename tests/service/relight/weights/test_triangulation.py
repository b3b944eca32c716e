import numpy as np
import pytest
from scipy.spatial import ConvexHull

from service.relight.weights.triangulation import triangulate_sphere
from tests.kernels.relight.lights import AXES, CUBE, dodecahedron, icosahedron, ring, scattered, turn
from tests.reference.sampling import lattice
from tests.scenes.in_front import unit

LAYOUTS = {
    "tetrahedron": CUBE[[0, 3, 5, 6]], "octahedron": AXES, "cube": CUBE, "icosahedron": icosahedron(), "dodecahedron": dodecahedron(),
    "rings": np.concatenate([ring(24, e) for e in (-75, -45, -15, 15, 45, 75)]),
    "rings and poles": np.concatenate([AXES[[1, 4]], *(ring(12, e) for e in (-60, -30, 0, 30, 60))]),
    "dome": np.concatenate([AXES[[1]], *(ring(24, e) for e in (0, 20, 40, 60))]), "even": lattice(500, 180), "half": lattice(96, 90),
    "front": lattice(331, 60), "a ring and one": np.concatenate([ring(36, 0), AXES[[1]]]), "four in front": lattice(4, 50),
    "two heaps": np.concatenate([lattice(10, 5), -lattice(10, 5)]), "near rings": np.concatenate([ring(19, 0), ring(19, 3)]),
    "any": scattered(300, 4), "any five": scattered(5, 0),
}
"""Regular ones, so that many lights lie on one circle; ones with holes; and ones on one side."""


def planes(corners):
    normal = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    return normal, (normal * corners[:, 0]).sum(axis=1)


@pytest.mark.long
@pytest.mark.parametrize("direction", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("seed", [None, 0])
def test_triangles_cover_the_sphere_once(direction, seed):
    direction = direction if seed is None else direction @ turn(seed).T
    got = triangulate_sphere(direction)
    np.testing.assert_array_equal(got.vertex[: len(direction)], direction)
    assert len(got.corner) == 2 * len(got.vertex) - 4  # Euler, of a closed surface of triangles
    assert len(np.unique(got.corner)) == len(got.vertex)
    vertex = unit(got.vertex)
    normal, height = planes(vertex[got.corner])
    assert (height > np.cos(np.radians(80)) - 1e-9).all()  # the centre is inside
    assert ((normal @ vertex.T).max(axis=1) < height + 1e-9).all()  # convex, but for the shift of 1e-10
    for k in range(3):
        beyond = got.corner[got.neighbour[:, k]]
        for end in (1, 2):  # shares the edge opposite to corner k
            assert (beyond == got.corner[:, (k + end) % 3, None]).any(axis=1).all()
        assert (beyond != got.corner[:, k, None]).all()


@pytest.mark.parametrize("direction", LAYOUTS.values(), ids=LAYOUTS)
def test_energy_is_shared_out_whole(direction):
    got = triangulate_sphere(direction)
    assert got.share.min() >= 0
    np.testing.assert_allclose(got.share.sum(axis=1), 1, rtol=1e-13)
    np.testing.assert_array_equal(got.share[: len(direction)], np.eye(len(direction)))


@pytest.mark.parametrize("count", [10, 30, 100, 300])
@pytest.mark.parametrize("seed", range(3))
def test_triangles_are_the_convex_hull(count, seed):
    """By SciPy, of the lights and the imaginary ones."""
    got = triangulate_sphere(scattered(count, seed))
    hull = ConvexHull(unit(got.vertex))
    assert {frozenset(face) for face in got.corner.tolist()} == {frozenset(face) for face in hull.simplices.tolist()}


@pytest.mark.parametrize("direction, imaginary", [
    (AXES, []), (icosahedron(), []), (CUBE, AXES), (dodecahedron(), icosahedron()[:, ::-1]),
    (np.concatenate([ring(24, 0), AXES[[1]]]), AXES[[4]]), (lattice(20, 180), []),
], ids=["octahedron", "icosahedron", "cube", "dodecahedron", "dome", "all around"])
def test_where_imaginary_lights_are(direction, imaginary):
    """In the middle of a square or pentagon, and below a dome; each shared out evenly over the corners."""
    got = triangulate_sphere(direction)
    assert len(got.vertex) - len(direction) == len(imaginary)
    for vertex, share in zip(got.vertex[len(direction) :], got.share[len(direction) :], strict=True):
        assert np.linalg.norm(np.array(imaginary) - vertex / np.linalg.norm(vertex), axis=1).min() < 1e-9
        near = direction @ vertex > (direction @ vertex).max() - 1e-6
        np.testing.assert_allclose(share, near / near.sum(), atol=1e-13)


def test_the_middle_of_a_polygon_lies_in_its_plane():
    got = triangulate_sphere(dodecahedron())
    np.testing.assert_allclose(got.vertex[20:], got.share[20:] @ dodecahedron(), atol=1e-15)


@pytest.mark.parametrize("count, largest", [(96, 90), (200, 120), (331, 145)])
def test_a_hole_has_one_imaginary_light_in_its_middle(count, largest):
    """Behind the cap that the lights fill."""
    direction = lattice(count, largest)
    got = triangulate_sphere(direction)
    behind = got.share[count:][got.vertex[count:, 2] < -0.95]
    assert len(behind) == 1
    assert behind[0][count - 30 :].sum() > 0.99 and behind[0].max() < 0.15  # to the rim, and not to a few of it
