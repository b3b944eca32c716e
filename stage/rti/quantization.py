"""Quantisation of coefficients to bytes: value = step · (byte − zero), with one step and one zero for each term of a file.

The byte `zero` stands for the value 0, so that pixels outside the mask are black.
"""

from typing import NamedTuple

import numpy as np

TOP = 255
"""The largest byte."""


class Quantization(NamedTuple):
    """The step and the zero of each term."""

    step: np.ndarray  # [terms] float32, above 0
    zero: np.ndarray  # [terms] int, 0…255: the byte whose value is 0


def quantization_of_range(low: np.ndarray, high: np.ndarray) -> Quantization:
    """Return the quantisation that covers the range of each term, widened to contain 0.

    Args:
        low, high: [terms] the least and the largest coefficient.
    """
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    span = high - low
    step = np.where(span > 0, span / TOP, 1.0).astype(np.float32)
    return Quantization(step, np.clip(np.rint(-low / step), 0, TOP).astype(int))


def quantize(coefficients: np.ndarray, quantization: Quantization) -> np.ndarray:
    """Return the nearest byte of each coefficient.

    Args:
        coefficients: [terms, …].

    Returns:
        [terms, …] uint8; a coefficient outside the range takes the nearest end of the range.
    """
    shape = (-1,) + (1,) * (coefficients.ndim - 1)
    levels = np.rint(coefficients / quantization.step.reshape(shape)) + quantization.zero.reshape(shape)
    return np.clip(levels, 0, TOP).astype(np.uint8)


def dequantize(stored: np.ndarray, quantization: Quantization) -> np.ndarray:
    """Return the coefficients [terms, …] float32 of bytes [terms, …] uint8."""
    shape = (-1,) + (1,) * (stored.ndim - 1)
    zero = quantization.zero.reshape(shape).astype(np.float32)
    return (stored.astype(np.float32) - zero) * quantization.step.reshape(shape)
