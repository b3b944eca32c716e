"""The layout of the grid, the walks over it, and the multigrid solver."""

import numpy as np
import pytest

from kernels.surface import grid as grids
from kernels.surface.grid import make_grid
from kernels.surface.multigrid import Multigrid
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
