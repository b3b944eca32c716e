"""Material maps that their pixels agree on: what each pixel says by itself, and what its neighbours say.

A pixel that saw no highlight says little about roughness and F0, and what it says is often far off, while a pixel beside it saw one. The
maps x of least

    Σ_p trust_p Σ_c |x_c(p) - v_c(p)|  +  Σ_(p,q) link_pq Σ_c |x_c(p) - x_c(q)|

keep the values v of trusted pixels, and with them borders and slopes; elsewhere they have few steps, at weak links. Both terms are
absolute, so that an outlier pulls no more the farther off it is.

Sources: the functional is that of Nikolova, "A variational approach to remove outliers and impulse noise", JMIV 2004, and Chan and
Esedoglu, "Aspects of total variation regularized L1 function approximation", SIAM 2005, with weights; minimised by the preconditioned
primal-dual steps of Pock and Chambolle, "Diagonal preconditioning for first order primal-dual algorithms", ICCV 2011.
"""

from collections.abc import Callable

import numpy as np
import warp as wp

from kernels import graphs
from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.surface.grid import Walk, end_cell, first_cell, make_grid, run

wp.set_module_options({"enable_backward": False})

STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Rows and columns to the neighbours that links lead to; with those that lead back, the eight around a pixel."""
GROUPS, GROUP = 30, 5
"""Steps of the minimisation, GROUP of which are one graph of launches on CUDA: on maps of DiLiGenT's cat and ball and of the owl sample,
seventy times as many change roughness by 0.001 to 0.004 in the mean."""
EASE_FALLS = 8.0
"""Slope over the trust with which the steps of maps become smaller and those of forces larger: a pixel without trust goes far, a trusted
one stays near what it says. Steps that are alike everywhere have to be 100 more."""


def between(step: tuple[int, int]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the rows and columns of an image whose neighbour at `step` is inside the image, and those of these neighbours."""
    down, right = step
    first, last = max(-right, 0), max(right, 0)
    return ((slice(None, -down or None), slice(first, -last or None)), (slice(down, None), slice(last, -first or None)))


@wp.kernel
def _pull(first: int,
          walk: Walk,
          links: wp.array2d(dtype=wp.float32),
          ease: wp.array(dtype=wp.float32),
          ahead: wp.array2d(dtype=wp.float32),
          way: wp.vec4i,
          # outputs
          forces: wp.array3d(dtype=wp.float32)):
    """Move the forces between pixels towards what the maps differ by; none is above its link."""
    t = first + wp.tid()
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        for k in range(4):
            link = links[k, i]
            if link > 0.0:
                pull = link / (ease[i] + ease[i + way[k]])
                for plane in range(ahead.shape[0]):
                    force = forces[plane, k, i] + pull * (ahead[plane, i + way[k]] - ahead[plane, i])
                    forces[plane, k, i] = wp.clamp(force, -link, link)


@wp.kernel
def _move(first: int,
          walk: Walk,
          given: wp.array2d(dtype=wp.float32),
          size: wp.array(dtype=wp.float32),  # of a step
          trust: wp.array(dtype=wp.float32),
          forces: wp.array3d(dtype=wp.float32),
          way: wp.vec4i,
          # outputs
          found: wp.array2d(dtype=wp.float32),
          ahead: wp.array2d(dtype=wp.float32)):
    """Move the maps as the forces push, and back towards what pixels say."""
    t = first + wp.tid()
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        if size[i] > 0.0:  # not of spare cells
            for plane in range(given.shape[0]):
                push = wp.float32(0.0)
                for k in range(4):
                    push += forces[plane, k, i - way[k]] - forces[plane, k, i]
                before, said = found[plane, i], given[plane, i]
                away = before - size[i] * push - said
                now = said + wp.sign(away) * wp.max(wp.abs(away) - size[i] * trust[i], 0.0)
                ahead[plane, i] = 2.0 * now - before
                found[plane, i] = now


def least_variation(values: np.ndarray, trust: np.ndarray, links: list[np.ndarray], *, device: str,
                    progress: Callable[[float], None] | None = None) -> np.ndarray:
    """Return the maps of least variation about given ones, [planes, rows, cols] float32.

    Args:
        values: [planes, rows, cols] what each pixel says.
        trust: [rows, cols] weight of that, 0 where a pixel says nothing.
        links: weights between the pixels of `between(step)` for each of STEPS, of the shape of these pixels; 0 where two are not linked.
        device: as Warp spells it. It holds 7 float32 values a pixel, and 7 for each of its planes.
        progress: told the fraction of the steps that are launched, 0…1.

    Raises:
        ArrayError: an array has another shape.
    """
    sides = [between(step) for step in STEPS]
    if trust.shape != values.shape[1:] or [link.shape for link in links] != [trust[one].shape for one, _ in sides]:
        raise ArrayError(f"trust is {trust.shape}, links {[link.shape for link in links]}: values are {values.shape}, so give one "
                         "trust for each pixel and one link for each pair of pixels")
    said = values[:, trust > 0]
    if not said.size:
        return values.astype(np.float32)
    planes, rows, cols = values.shape
    grid = make_grid(rows, cols, device)

    def laid_out(images: np.ndarray) -> wp.array:
        """Return [..., rows, cols] images as the grid has them, on the device."""
        cells = np.zeros((*images.shape[:-2], grid.size), np.float32)
        grid.pixels(cells)[...] = images
        return wp.array(cells, device=device)

    linked, ways = np.zeros((len(STEPS), rows, cols), np.float32), [down * grid.pitch + right for down, right in STEPS]
    total = np.zeros(trust.shape, np.float32)
    for (one, other), link, image in zip(sides, links, linked, strict=True):
        image[one] = link
        total[one] += link
        total[other] += link
    easy = 1 / (1 + EASE_FALLS * trust)
    given, weights, size = laid_out(values), laid_out(linked), laid_out(easy / np.maximum(total, 1e-6))
    found, ahead = wp.clone(given), wp.clone(given)
    forces = wp.zeros((planes, len(STEPS), grid.size), dtype=wp.float32, device=device)
    ease, trusted, way = laid_out(easy), laid_out(trust), wp.vec4i(*ways)

    def steps() -> None:
        for _ in range(GROUP):
            run(_pull, grid.cells, [weights, ease, ahead, way], [forces])
            run(_move, grid.cells, [given, size, trusted, forces, way], [found, ahead])

    group = graphs.Repeated(steps, device)
    for done in range(1, GROUPS + 1):
        group.run()
        if progress is not None:
            progress(done / GROUPS)
    # the minimum takes no value beyond those that pixels say; steps towards it may
    least, most = (limit(axis=1)[:, None, None].astype(np.float32) for limit in (said.min, said.max))
    return np.clip(grid.pixels(to_numpy(found)), least, most)
