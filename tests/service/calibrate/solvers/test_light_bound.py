"""What docs/methods.md says that images can tell of rough directions: the Cramér-Rao bound, against its closed form."""

import pytest

from tests.reference.light_directions import least_error_degrees


@pytest.mark.parametrize("count", [12, 16, 24])
def test_what_all_lights_share_is_left(count):
    """One of 3 × 3 numbers is a common strength, which turns no light: eight of 2n are those of the table. A turn, three, is left where the
    strengths are known, and a little more by readings of half a per cent."""
    assert least_error_degrees(count, table_degrees=5.0, strength=10.0) == pytest.approx(5 * (8 / (2 * count)) ** 0.5, rel=0.01)
    known = least_error_degrees(count, table_degrees=5.0, strength=0.001)
    assert known == pytest.approx(5 * (3 / (2 * count)) ** 0.5, rel=0.02)
    assert least_error_degrees(count, table_degrees=5.0, strength=0.1) == pytest.approx(
        {12: 2.66, 16: 2.31, 24: 1.88}[count], abs=0.03)  # the table of docs/methods.md
