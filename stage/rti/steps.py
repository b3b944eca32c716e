"""Coefficients in bytes: value = step · (byte − zero), one step and one zero for each term of a file.

Zero is one of the 256 values, so that pixels outside the mask are black.
"""

from typing import NamedTuple

import numpy as np

TOP = 255


class Steps(NamedTuple):
    """How the bytes of each term are read."""

    step: np.ndarray  # [terms] float32, above 0
    zero: np.ndarray  # [terms] int, 0…255: the byte whose value is 0


def steps_over(low: np.ndarray, high: np.ndarray) -> Steps:
    """Steps that cover a range of each term, which is widened to hold 0.

    Args:
        low, high: [terms] least and largest coefficient.
    """
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    span = high - low
    step = np.where(span > 0, span / TOP, 1.0).astype(np.float32)
    return Steps(step, np.clip(np.rint(-low / step), 0, TOP).astype(int))


def to_bytes(coefficients: np.ndarray, steps: Steps) -> np.ndarray:
    """The nearest bytes.

    Args:
        coefficients: [terms, …].

    Returns:
        [terms, …] uint8; a value beyond the range takes its end.
    """
    shape = (-1,) + (1,) * (coefficients.ndim - 1)
    levels = np.rint(coefficients / steps.step.reshape(shape)) + steps.zero.reshape(shape)
    return np.clip(levels, 0, TOP).astype(np.uint8)


def from_bytes(stored: np.ndarray, steps: Steps) -> np.ndarray:
    """[terms, …] float32 coefficients of [terms, …] uint8."""
    shape = (-1,) + (1,) * (stored.ndim - 1)
    return (stored.astype(np.float32) - steps.zero.reshape(shape).astype(np.float32)) * steps.step.reshape(shape)
