"""Steps of a surface that a depth map shows and its normals do not explain.

Two neighbours differ by the slope of their normals, the noise of both depths and the error of the slope. What exceeds that is a step, and
the surface is cut between the two. One or two depths between two steps of one sense are mixtures of both sides, as cameras make them at an
outline: they are left out first. Pixels without a depth take one over from a neighbour, along the slopes, over edges where the
normals turn little before those where they turn much: what comes from both sides of a step then meets at the outline.
"""

from typing import NamedTuple

import numpy as np

SIGNIFICANCE = 5.0
"""Difference in standard deviations that is a step: by chance one in a million pairs exceeds it."""
SLOPE_ERROR = np.radians(5.0)
"""Error of a normal, radians, that is allowed for beside its standard error: that of methods whose model does not quite hold."""
MIXED = 2
"""Number of pixels in line that may be mixtures."""
TURNS = (3.0, 10.0, np.inf)
"""Largest turns of normals over which depths are carried on, one after the other, in medians of all turns."""
CARRIED = 32
"""Number of pixels that a depth is carried on with each of TURNS."""


class Cuts(NamedTuple):
    """Edges that cross a step."""

    right: np.ndarray  # [rows, cols] bool, between a pixel and its right neighbour
    down: np.ndarray  # [rows, cols] bool, between a pixel and the one below
    depth: np.ndarray  # [rows, cols] bool, pixels whose depth is neither missing nor a mixture
    guessed: np.ndarray  # [rows, cols] bool, pixels beside a step without a depth of their own: which side they belong to is a guess


class Edges(NamedTuple):
    """The edges to the right, or those down, of each pixel."""

    slope: np.ndarray  # [rows, cols] rise by the normals, in units of the pixels' distance
    sigma: np.ndarray  # [rows, cols] its standard error
    turn: np.ndarray  # [rows, cols] angle between the normals at both ends, radians
    joined: np.ndarray  # [rows, cols] bool, whether there is an edge; False in the last column (row)


def find_steps(
    value: np.ndarray,  # [rows, cols] height in units of the pixels' distance
    sigma: np.ndarray,  # [rows, cols] its standard deviation
    known: np.ndarray,  # [rows, cols] bool, where there is a height
    right: Edges, down: Edges,
) -> Cuts:
    """Find the edges between pixels that cross a step."""
    edges = right, Edges(*(plane.T for plane in down))
    kept = known & ~_mixed(value, sigma, known, edges[0]) & ~_mixed(value.T, sigma.T, known.T, edges[1]).T
    filled, filled_sigma, reached = _carry_on(value, sigma, kept, edges)
    across = _significant(filled, filled_sigma, reached, edges[0])[1]
    along = _significant(filled.T, filled_sigma.T, reached.T, edges[1])[1].T
    beside = np.zeros(known.shape, dtype=bool)
    for cut, head, tail in ((across, np.s_[:, :-1], np.s_[:, 1:]), (along, np.s_[:-1], np.s_[1:])):
        beside |= cut
        beside[tail] |= cut[head]
    return Cuts(across, along, kept, beside & ~kept)


def _significant(value: np.ndarray, sigma: np.ndarray, known: np.ndarray, edges: Edges) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps over the edges to the right in standard deviations, and where they are steps, [rows, cols] each."""
    jump = np.zeros(value.shape)
    step = np.diff(value, axis=1) - edges.slope[:, :-1]
    jump[:, :-1] = step / np.sqrt(sigma[:, 1:] ** 2 + sigma[:, :-1] ** 2 + edges.sigma[:, :-1] ** 2)
    held = edges.joined.copy()
    held[:, :-1] &= known[:, 1:] & known[:, :-1]
    jump = np.where(held, jump, 0)
    return jump, np.abs(jump) > SIGNIFICANCE


def _mixed(value: np.ndarray, sigma: np.ndarray, known: np.ndarray, edges: Edges) -> np.ndarray:
    """Return the pixels between two steps of one sense, to the left and to the right."""
    out = np.zeros(known.shape, dtype=bool)
    jump, step = _significant(value, sigma, known, edges)
    sense = np.where(step, np.sign(jump), 0)
    for width in range(1, min(MIXED, value.shape[1] - 2) + 1):
        between = (sense[:, : -width - 1] != 0) & (sense[:, : -width - 1] == sense[:, width:-1])
        for pixel in range(1, width + 1):
            out[:, pixel : pixel + between.shape[1]] |= between
    return out


def _carry_on(value: np.ndarray, sigma: np.ndarray, known: np.ndarray,
              edges: tuple[Edges, Edges]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return values, their standard deviations, and where there are any, with those of pixels around known ones."""
    value, sigma, known = np.where(known, value, 0), sigma.copy(), known.copy()
    turns = np.concatenate([e.turn[e.joined] for e in edges])
    usual = float(np.median(turns)) if turns.size else 0.0
    for factor in TURNS:
        open_edges = [e.joined & (e.turn <= factor * usual if np.isfinite(factor) else True) for e in edges]
        for _ in range(CARRIED):
            if not _grow(value, sigma, known, edges, (open_edges[0], open_edges[1])):
                break
    return value, sigma, known


def _grow(value: np.ndarray, sigma: np.ndarray, known: np.ndarray, edges: tuple[Edges, Edges],
          open_edges: tuple[np.ndarray, np.ndarray]) -> bool:
    """Give pixels beside known ones, in place, the value that the neighbour with the most alike normal has there; return if any was."""
    least = np.full(value.shape, np.inf)
    new_value, new_sigma = value.copy(), sigma.copy()
    for flipped, (e, opened) in enumerate(zip(edges, open_edges, strict=True)):
        v, s, k, best, nv, ns = (plane.T if flipped else plane for plane in (value, sigma, known, least, new_value, new_sigma))
        for back in (False, True):
            into, source = (np.s_[:, :-1], np.s_[:, 1:]) if back else (np.s_[:, 1:], np.s_[:, :-1])
            edge = np.s_[:, :-1]
            better = opened[edge] & k[source] & ~k[into] & (e.turn[edge] < best[into])
            best[into] = np.where(better, e.turn[edge], best[into])
            nv[into] = np.where(better, v[source] + (-1 if back else 1) * e.slope[edge], nv[into])
            ns[into] = np.where(better, np.sqrt(s[source] ** 2 + e.sigma[edge] ** 2), ns[into])
    reached = np.isfinite(least)
    value[reached], sigma[reached], known[reached] = new_value[reached], new_sigma[reached], True
    return bool(reached.any())
