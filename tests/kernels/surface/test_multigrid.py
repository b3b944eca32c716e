"""Parts of the height solver (multigrid cycles, connected components), and nearest points of a mesh."""

import numpy as np
import pytest
from scipy import ndimage

from kernels.errors import ArrayError
from kernels.surface import grid as grids
from kernels.surface.components import label_runs
from kernels.surface.grid import make_grid
from kernels.surface.multigrid import Multigrid
from kernels.surface.nearest import NearestOnMesh
from tests.kernels.surface import shapes


def hierarchy(mask, device, *, contrast=0.0, seed=0):
    """A V-cycle as a function of flat pixels, and its matrix's product, both on the host."""
    rows, cols = mask.shape
    grid, rng = make_grid(rows, cols, device), np.random.default_rng(seed)
    inside = np.zeros((rows + 3, grid.pitch))
    inside[1 : rows + 1, 1 : cols + 1] = mask
    right, down = (inside * 10 ** rng.uniform(-contrast, 0, inside.shape) for _ in range(2))
    right *= np.roll(inside, -1, axis=1)
    down *= np.roll(inside, -1, axis=0)
    weights, (target_on_device, answer, scratch) = grid.no_edges(), (grid.zeros() for _ in range(3))
    weights.right.assign(right.ravel().astype(np.float32))
    weights.down.assign(down.ravel().astype(np.float32))
    multigrid = Multigrid(grid, weights, target=target_on_device, value=answer, scratch=scratch)
    here = np.flatnonzero(inside.ravel())

    def cycle(target):
        flat = np.zeros(grid.size, dtype=np.float32)
        flat[here] = target
        target_on_device.assign(flat)
        multigrid.cycle()
        return answer.numpy()[here].astype(np.float64)

    def product(value):
        v = np.zeros(grid.size)
        v[here] = value
        flow_x, flow_y = right.ravel() * (np.roll(v, -1) - v), down.ravel() * (np.roll(v, -grid.pitch) - v)
        return (np.roll(flow_x, 1) - flow_x + np.roll(flow_y, grid.pitch) - flow_y)[here]

    return cycle, product, here.size


@pytest.mark.parametrize("contrast", [0.0, 4.0])
@pytest.mark.parametrize("size", [(33, 50), (64, 64), (1, 37), (5, 2)])
def test_cycle_is_symmetric_and_positive(size, contrast, device):
    mask = shapes.ragged_mask(*size) if min(size) > 8 else np.ones(size, dtype=bool)
    cycle, product, count = hierarchy(mask, device, contrast=contrast)
    rng = np.random.default_rng(1)
    for _ in range(3):
        u, v = (product(rng.normal(size=count)) for _ in range(2))
        bu, bv = cycle(u), cycle(v)
        scale = np.sqrt((u @ bu) * (v @ bv))
        assert u @ bu > 0.0
        assert abs(u @ bv - v @ bu) < 1e-5 * scale  # float32 in the cycle


@pytest.mark.parametrize("size", [(64, 64), (67, 131), (256, 256)])
def test_cycle_is_close_to_the_inverse(size, device):
    cycle, product, count = hierarchy(np.ones(size, dtype=bool), device)
    wanted = np.random.default_rng(2).normal(size=count)
    wanted -= wanted.mean()
    error = wanted.copy()
    for _ in range(6):
        error -= cycle(product(error))
        error -= error.mean()
    assert (np.linalg.norm(error) / np.linalg.norm(wanted)) ** (1 / 6) < 0.4  # alone; measured 0.32


def visited(sweep):
    walk = sweep.walk
    begins = walk.start + np.arange(sweep.threads) * walk.apart
    return np.sort(np.concatenate([np.arange(begin, min(begin + walk.span, walk.end), walk.step) for begin in begins]))


@pytest.mark.long
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (7, 10), (131, 257), (300, 301)])
@pytest.mark.parametrize("layout", ["cpu", "cuda:0"])
def test_every_pixel_is_visited_once(size, layout):
    grid = grids.make_grid(*size, layout)
    rows, cols = np.indices(size)
    pixels = ((rows + 1) * grid.pitch + cols + 1).ravel()
    assert grid.pitch % 2 == 1
    assert ((pixels + rows.ravel() + cols.ravel()) % 2 == pixels[0] % 2).all()  # parity is the chessboard colour
    for sweep in (grid.cells, grid.sums):
        cells = visited(sweep)
        assert np.unique(cells).size == cells.size
        assert np.isin(pixels, cells).all()
        assert cells[0] >= grid.pitch and cells[-1] + grid.pitch < grid.size
    both = np.concatenate([visited(grid.even), visited(grid.odd)])
    assert (np.sort(both) == visited(grid.cells)).all()
    assert (visited(grid.even) % 2 == 0).all()


@pytest.mark.parametrize("count", [1, 255, 256, 257, 5000])
def test_sum_of_many_parts(count, device):
    grid = grids.make_grid(4, 4, device)
    summer = grids.Summer(grid._replace(sums=grid.sums._replace(threads=count)))
    summer.partial.assign(np.arange(count) + 0.5)
    total = grids.make_grid(1, 3, device).zeros(grids.wp.float64)
    summer.finish(total, 2)
    assert total.numpy()[2] == pytest.approx(count * count / 2, rel=1e-14)
    assert (np.delete(total.numpy(), 2) == 0.0).all()


def painted(runs, shape):
    label = np.full(shape, -1)
    for row, first, end, number in zip(runs.row, runs.first_col, runs.end_col, runs.label, strict=True):
        label[row, first:end] = number
    return label


def spiral(n):
    """A path one pixel wide, wound to the middle."""
    mask = np.zeros((n, n), dtype=bool)
    r, c, dr, dc = 0, 0, 0, 1
    mask[0, 0] = True
    for length in [n - 1, *np.repeat(np.arange(n - 1, 0, -2), 2)]:
        for _ in range(length):
            r, c = r + dr, c + dc
            mask[r, c] = True
        dr, dc = dc, -dr
    return mask


@pytest.mark.parametrize(
    "mask",
    [
        *(np.random.default_rng(int(100 * f)).random((57, 83)) < f for f in (0.1, 0.45, 0.6, 0.65, 0.9)),
        np.ones((5, 7), dtype=bool),
        np.zeros((5, 7), dtype=bool),
        np.ones((1, 1), dtype=bool),
        np.ones((9, 1), dtype=bool),
        np.arange(12).reshape(1, 12) % 3 > 0,
        spiral(41),
        np.indices((20, 20)).sum(0) % 2 == 0,
    ],
)
def test_labels_match_scipy(mask):
    runs = label_runs(mask)
    expected, count = ndimage.label(mask)
    label = painted(runs, mask.shape)
    assert runs.count == count
    assert ((label >= 0) == mask).all()
    assert len(set(zip(label[mask], expected[mask], strict=True))) == count


def octahedron() -> tuple[np.ndarray, np.ndarray]:
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    upper = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4]])
    return points, np.concatenate([upper, np.where(upper[:, ::-1] == 4, 5, upper[:, ::-1])])


def nearest_of(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The distance of each point [n] to the nearest of [f, 3, 3] triangles: within its plane, along its sides, or at its corners."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    from_a = points[:, None] - a
    height = (from_a * normal).sum(-1)
    foot = points[:, None] - height[..., None] * normal
    within = np.ones(height.shape, bool)
    least = np.full(height.shape, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        side = end - start
        within &= (np.cross(side, foot - start) * normal).sum(-1) >= 0
        along = np.clip(((points[:, None] - start) * side).sum(-1) / (side**2).sum(-1), 0, 1)
        least = np.minimum(least, np.linalg.norm(points[:, None] - start - along[..., None] * side, axis=-1))
    return np.where(within, np.abs(height), least).min(axis=1)


@pytest.mark.parametrize(("scale", "at"), [(1.0, 0.0), (1e-3, 0.5)])
def test_distances_and_sides_of_an_octahedron(device, scale, at):
    corners, faces = octahedron()
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (500, 3))
    found = NearestOnMesh(scale * corners + at, faces, device=device).search(scale * points + at, 10 * scale)
    place = np.einsum("nk,nki->ni", found.share, corners[faces[found.face]])
    assert np.abs(np.linalg.norm(points - place, axis=1) - nearest_of(points, corners[faces])).max() < 2e-6  # float32 of sizes of 3
    assert (found.outside == (np.abs(points).sum(axis=1) > 1)).all()
    assert found.share.min() > -1e-6 and np.allclose(found.share.sum(axis=1), 1)


def test_what_is_too_far_has_no_face_and_faces_need_their_points(device):
    corners, faces = octahedron()
    found = NearestOnMesh(corners, faces, device=device).search(np.array([[0.0, 0, 3.0], [0, 0, 1.05]]), 0.1)
    assert found.face[0] == -1 and found.face[1] >= 0
    assert len(NearestOnMesh(corners, faces, device=device).search(np.zeros((0, 3)), 1.0).face) == 0
    for wrong in (faces[:0], faces + 1):
        with pytest.raises(ArrayError, match="points"):
            NearestOnMesh(corners, wrong, device=device)
