"""The layout and the walks over it, those for CUDA included: they are plain integers and need no device."""

import numpy as np
import pytest

from kernels.surface import grid as grids


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
