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

import numpy as np

from kernels.errors import ArrayError

STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Rows and columns to the neighbours that links lead to; with those that lead back, the eight around a pixel."""
ITERATIONS = 250
"""Steps of the minimisation: on the maps of the owl sample, 1000 change roughness by less than 0.002 in the mean."""


def between(step: tuple[int, int]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the rows and columns of an image whose neighbour at `step` is inside the image, and those of these neighbours."""
    down, right = step
    first, last = max(-right, 0), max(right, 0)
    return ((slice(None, -down or None), slice(first, -last or None)), (slice(down, None), slice(last, -first or None)))


def least_variation(values: np.ndarray, trust: np.ndarray, links: list[np.ndarray], *, iterations: int = ITERATIONS) -> np.ndarray:
    """Return the maps of least variation about given ones, [planes, rows, cols] float32.

    Args:
        values: [planes, rows, cols] what each pixel says.
        trust: [rows, cols] weight of that, 0 where a pixel says nothing.
        links: weights between the pixels of `between(step)` for each of STEPS, of the shape of these pixels; 0 where two are not linked.

    Raises:
        ArrayError: an array has another shape.
    """
    sides = [between(step) for step in STEPS]
    if trust.shape != values.shape[1:] or [link.shape for link in links] != [trust[one].shape for one, _ in sides]:
        raise ArrayError(f"trust is {trust.shape}, links {[link.shape for link in links]}: values are {values.shape}, so give one "
                         "trust for each pixel and one link for each pair of pixels")
    given = values.astype(np.float32)
    linked = np.zeros(trust.shape, np.float32)
    for (one, other), link in zip(sides, links, strict=True):
        linked[one] += link
        linked[other] += link
    step = 1 / np.maximum(linked, 1e-6)
    pull = step * trust
    found, ahead = given.copy(), given.copy()
    forces = [np.zeros((len(values), *link.shape), np.float32) for link in links]  # between two pixels, at most their link
    for _ in range(iterations):
        push = np.zeros_like(given)
        for (one, other), link, force in zip(sides, links, forces, strict=True):
            force += 0.5 * link * (ahead[:, *other] - ahead[:, *one])
            np.clip(force, -link, link, out=force)
            push[:, *other] += force
            push[:, *one] -= force
        moved = found - step * push - given
        moved = given + np.copysign(np.maximum(np.abs(moved) - pull, 0), moved)
        ahead, found = 2 * moved - found, moved
    return found
