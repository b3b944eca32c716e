"""Frequencies and what they can tell."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.tof.continuous.modulation import common_range_m, radians_per_metre, require_ascending, require_span
from tests.reference.tof import LIGHT


@pytest.mark.parametrize(("hz", "base"), [((20e6, 30e6, 80e6), 10e6), ((16e6, 80e6, 120e6), 8e6), ((30e6,), 30e6), ((20e6, 20e6), 20e6),
                                          ((100e6, 30e6), 10e6)])
def test_common_range_is_that_of_the_common_divisor(hz, base):
    assert common_range_m(hz, LIGHT) == pytest.approx(LIGHT / (2 * base))


def test_a_metre_is_four_pi_f_over_c():
    assert radians_per_metre([30e6], LIGHT)[0] * 2.498270483 == pytest.approx(np.pi, rel=1e-8)


def test_a_span_beyond_the_common_range_is_refused_and_the_range_said():
    require_span((20e6, 30e6), 0, 14.98, LIGHT)
    with pytest.raises(ArrayError, match=r"20, 30 MHz repeat after 14.99 m, 20 m were asked for"):
        require_span((20e6, 30e6), 0, 20, LIGHT)
    with pytest.raises(ArrayError, match="no span"):
        require_span((20e6, 30e6), 3, 2, LIGHT)


@pytest.mark.parametrize("hz", [(), (0.0,), (-20e6,), (np.nan,), (20e6, np.inf)])
def test_frequencies_must_be_above_zero(hz):
    with pytest.raises(ArrayError, match="above zero"):
        radians_per_metre(hz, LIGHT)


def test_times_must_ascend():
    require_ascending([0, 1, 2], "bins")
    with pytest.raises(ArrayError, match="bins are out of order: number 2"):
        require_ascending([0, 2, 1], "bins")
