"""The captured images of an object as few planes, the same for all lights and channels, and how a light mixes them.

    display value[c] under captured light l = Σₚ basis[p, l, c] · plane[p]

with the principal components, without a mean so that black stays black, of display values over lights and channels; between the captured
lights the basis is a sum of normalised Gaussians. It is stored on a grid of directions, of which viewers interpolate the nearest four: the
type `bilinear`, colour space `mrgb`, of the relight format. (Its type `rbf` stores a value for each captured light, which versions of
OpenLIME interpolate differently.) The grid is stored in bytes: planes are fitted to the bytes.

Source: Ponchio, Corsini and Scopigno, "Relight: A compact and accurate RTI representation for the web", Graphical Models 105, 2019.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg, spatial
from scipy.sparse import csgraph

PLANES = 27
"""Most planes: nine images of three."""
SPACING_PART = 0.5
"""Width of the Gaussians over the usual distance between neighbouring lights: at its neighbour's place a light counts 2 %."""
LEAST_WEIGHT = 1e-3
"""Weights up to this count nothing."""
GRID_SPAN = 6.0
"""Directions along a side of the grid, times the distance of neighbouring lights, of which a cell is at most half."""
GRID_SIDES = (16, 48)
"""Fewest and most directions along a side of the grid; with the most, info.json has 0.7 MB."""
ALIKE = 0.1
"""What the grid tells apart less than this is left as the Gaussians have it, as lights that nearly coincide."""
BASIS_ZERO, BASIS_REACH = 127, 127
"""The byte of 0 in the stored basis, and its steps to either side."""


class Components(NamedTuple):
    """The basis of a capture, as it is stored."""

    directions: np.ndarray  # [lights, 3] unit vectors
    side: int  # directions along a side of the grid
    stored: np.ndarray  # [planes, side², 3] uint8
    ranges: np.ndarray  # [planes], steps for a unit

    @property
    def basis(self) -> np.ndarray:
        """The basis that viewers find under the captured lights, [planes, lights, 3] float64."""
        grid = (self.stored.astype(float) - BASIS_ZERO) / self.ranges[:, None, None]
        return np.einsum("lg,pgc->plc", grid_weights(self.directions, self.side), grid, optimize=True)

    @property
    def fit(self) -> np.ndarray:
        """Weights [planes, lights, 3] of display values, whose sums are the planes that fit best."""
        basis = self.basis
        return np.asarray(np.linalg.pinv(basis.reshape(len(basis), -1)).T.reshape(basis.shape))


def components_of(values: np.ndarray, directions: np.ndarray) -> Components:
    """Return the basis of display values [3, lights, pixels] under lights from directions [lights, 3]."""
    channels, lights, pixels = values.shape
    flat = values.reshape(channels * lights, pixels).astype(np.float64)
    count = min(PLANES, len(flat))
    vectors = linalg.eigh(flat @ flat.T, subset_by_index=(len(flat) - count, len(flat) - 1))[1].T[::-1]
    basis = vectors.reshape(count, channels, lights).swapaxes(1, 2)
    side = int(np.clip(GRID_SPAN / max(light_spacing(directions), 1e-3), *GRID_SIDES))
    gaussians = light_weights(directions, grid_directions(side))
    seen = np.linalg.pinv(grid_weights(directions, side) @ gaussians, rcond=ALIKE)  # heights that give the basis itself
    grid = np.einsum("gl,lm,pmc->pgc", gaussians, seen, basis, optimize=True)
    ranges = BASIS_REACH / np.abs(grid).max(axis=(1, 2))
    stored = np.rint(grid * ranges[:, None, None]) + BASIS_ZERO
    return Components(directions, side, stored.astype(np.uint8), ranges)


def grid_directions(side: int) -> np.ndarray:
    """Return the directions of the grid [side², 3], rows of v with columns of u.

    Convention: the upper half of an octahedron |x| + |y| + |z| = 1, turned by 45 degrees: u = x + y and v = y − x, both from −1 to 1.
    """
    v, u = np.meshgrid(*2 * [np.linspace(-1, 1, side)], indexing="ij")
    x, y = (u - v).ravel() / 2, (u + v).ravel() / 2
    found = np.stack([x, y, 1 - np.abs(x) - np.abs(y)], axis=1)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def grid_weights(wanted: np.ndarray, side: int) -> np.ndarray:
    """Return how much each direction of the grid counts in a light from `wanted` [n, 3], z ≥ 0, [n, side²]; the sum is 1."""
    x, y = (wanted[:, :2] / np.abs(wanted).sum(axis=1, keepdims=True)).T
    weights = []
    for place in (y - x, x + y):
        place = (place + 1) / 2 * (side - 1)
        weights.append(np.maximum(0, 1 - np.abs(place[:, None] - np.arange(side))))
    return np.asarray((weights[0][:, :, None] * weights[1][:, None, :]).reshape(len(wanted), -1))


def light_weights(directions: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return how much each captured light counts in a light from `wanted` [n, 3], [n, lights]; the sum is 1."""
    squares = np.square(spatial.distance.cdist(wanted, directions))
    width = SPACING_PART * light_spacing(directions)
    weights = np.exp((squares.min(axis=1, keepdims=True) - squares) / width**2)  # relative to the nearest, so that not all vanish
    weights /= weights.sum(axis=1, keepdims=True)
    weights[weights <= LEAST_WEIGHT] = 0
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def light_spacing(directions: np.ndarray) -> float:
    """Return the distance that most neighbouring lights have, between unit vectors.

    Neighbours are those of the minimum spanning tree, whose upper quartile is the distance between groups where lights stand in pairs.
    """
    steps = csgraph.minimum_spanning_tree(spatial.distance.cdist(directions, directions)).data
    return float(np.quantile(steps, 0.75)) if len(steps) else 1.0
