"""Coefficients in bytes."""

import numpy as np
import pytest

from stage.formats.rti import dequantize, quantization_of_range, quantize


@pytest.mark.parametrize("low, high", [(-3.0, 5.0), (2.0, 7.0), (-7.0, -2.0), (0.0, 1e-6), (-1e4, 0.0)])
def test_a_coefficient_comes_back_within_half_a_step(low, high):
    quantization = quantization_of_range(np.array([low]), np.array([high]))
    values = np.linspace(low, high, 1001)[None]
    back = dequantize(quantize(values, quantization), quantization)
    # zero is a whole number of steps from the ends, so that an end may lie half a step outside; and the rounding of floats
    assert np.abs(back - values).max() <= 0.5 * quantization.step[0] + 2.0**-22 * max(abs(low), abs(high))
    assert quantization.step[0] == pytest.approx((max(high, 0) - min(low, 0)) / 255)


def test_zero_is_exact():
    quantization = quantization_of_range(np.array([-3.0, 2.0, 0.0]), np.array([5.0, 7.0, 0.0]))
    assert not dequantize(quantize(np.zeros((3, 4)), quantization), quantization).any()
    assert (quantization.zero >= 0).all() and (quantization.zero <= 255).all() and (quantization.step > 0).all()


def test_what_is_beyond_the_range_takes_its_end():
    quantization = quantization_of_range(np.array([-1.0]), np.array([1.0]))
    assert quantize(np.array([[-9.0, 9.0]]), quantization).tolist() == [[0, 255]]
