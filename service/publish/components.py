"""The captured images of an object as few planes, the same for all lights and channels, and how a light mixes them.

    display value[c] under captured light l = Σₚ basis[p, l, c] · plane[p]

with the principal components, without a mean so that black stays black, of display values over lights and channels; between the captured
lights the basis is interpolated by normalised Gaussians. This is the type `rbf`, colour space `mrgb`, of the relight format, which stores
the basis in bytes: planes are fitted to the bytes.

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
"""Weights up to this count nothing, as viewers have it."""
BASIS_ZERO, BASIS_REACH = 127, 127
"""The byte of 0 in the stored basis, and its steps to either side."""


class Components(NamedTuple):
    """The basis of a capture, as it is stored."""

    directions: np.ndarray  # [lights, 3] unit vectors
    sigma: float
    stored: np.ndarray  # [planes, lights, 3] uint8
    ranges: np.ndarray  # [planes], steps for a unit

    @property
    def basis(self) -> np.ndarray:
        """The basis that viewers read, [planes, lights, 3] float64."""
        return np.asarray((self.stored.astype(float) - BASIS_ZERO) / self.ranges[:, None, None])

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
    ranges = BASIS_REACH / np.abs(basis).max(axis=(1, 2))
    stored = np.rint(basis * ranges[:, None, None]) + BASIS_ZERO
    return Components(directions, gaussian_width(directions), stored.astype(np.uint8), ranges)


def light_weights(directions: np.ndarray, sigma: float, wanted: np.ndarray) -> np.ndarray:
    """Return how much each captured light counts in a light from `wanted` [n, 3], [n, lights]; the sum is 1."""
    squares = np.square(spatial.distance.cdist(wanted, directions))
    weights = np.exp((squares.min(axis=1, keepdims=True) - squares) / sigma**2)  # relative to the nearest, so that not all vanish
    weights /= weights.sum(axis=1, keepdims=True)
    weights[weights <= LEAST_WEIGHT] = 0
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def gaussian_width(directions: np.ndarray) -> float:
    """Return the width of the Gaussians between lights: a part of the distance that most neighbours have.

    Neighbours are those of the minimum spanning tree, whose upper quartile is the distance between groups where lights stand in pairs.
    """
    steps = csgraph.minimum_spanning_tree(spatial.distance.cdist(directions, directions)).data
    return SPACING_PART * (float(np.quantile(steps, 0.75)) if len(steps) else 1.0)
