"""Three fitted channels as one: a colour and a luminance function at each pixel, for files that keep only that (LRGB).

Source: Malzbender, Gelb and Wolters, "Polynomial Texture Maps", SIGGRAPH 2001: the colour is constant, the luminance follows the light.
"""

from typing import NamedTuple

import numpy as np

ROUNDS = 8
"""Rounds of the power iteration for the colour. It converges by the ratio of the squared eigenvalues, which is ten or more on real
surfaces."""
WHITE = 255.0
"""Value of white in the files, which store a colour in 8 bits."""


class Luminance(NamedTuple):
    """Channel value = colour / 255 · luminance."""

    colour: np.ndarray  # [3, pixels] uint8
    coefficients: np.ndarray  # [terms, pixels] float32, of a luminance whose white is 255


def separate(coefficients: np.ndarray, functions: np.ndarray) -> Luminance:
    """Return the product of a colour and a luminance function that is closest to three fitted channels.

    Args:
        coefficients: [terms, 3, pixels] float32, of channels whose white is 255.
        functions: [lights, terms] over which closeness is meant.

    Returns:
        The colour that the brightest of the lights shows, at most white, so that each pixel's luminance reaches 255; 0 where it
        is black.
    """
    moments = functions.T @ functions
    spread = np.einsum("tcp,ts,sdp->pcd", coefficients, moments.astype(np.float32), coefficients, optimize=True)
    colour = np.maximum(np.einsum("t,tcp->pc", functions.sum(axis=0).astype(np.float32), coefficients), 0)
    for _ in range(ROUNDS):
        colour = _unit(np.einsum("pcd,pd->pc", spread, colour))
    colour = _unit(np.maximum(colour, 0))
    along = np.einsum("tcp,pc->tp", coefficients, colour)
    peak = (functions.astype(np.float32) @ along).max(axis=0)
    brightest = np.maximum(colour.max(axis=1), 1e-6)
    reach = np.clip(peak, 0, WHITE / brightest)  # no channel of the colour above white
    stored = np.rint(colour * reach[:, None]).astype(np.uint8)
    exact = stored.astype(np.float32)
    squares = np.maximum((exact * exact).sum(axis=1), 1)
    luminance = np.einsum("tcp,pc->tp", coefficients, exact) * (WHITE / squares)
    return Luminance(np.ascontiguousarray(stored.T), luminance)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-20)
