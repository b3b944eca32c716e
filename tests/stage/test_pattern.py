"""Projected patterns: the codes of the contract, and what cannot be one."""

import pytest
from pydantic import TypeAdapter, ValidationError

from stage.patterns.codes import Pattern


@pytest.mark.parametrize(("data", "words"), [
    ({"code": "gray", "axis": "column", "bit": 4, "bits": 4}, "bit 4 does not exist in 4 bits"),
    ({"code": "gray", "axis": "column", "bit": -1, "bits": 4}, "bit"),
    ({"code": "binary", "axis": "diagonal", "bit": 0, "bits": 4}, "axis"),
    ({"code": "binary", "axis": "row", "bit": 0, "bits": 4, "stripe_px": 0}, "stripe_px"),
    ({"code": "kary", "axis": "row", "base": 1, "digit": 0, "digits": 1, "levels": [0]}, "base"),
    ({"code": "kary", "axis": "row", "base": 2, "digit": 2, "digits": 2, "levels": [0, 1]}, "digit 2 does not exist"),
    ({"code": "kary", "axis": "row", "base": 2, "digit": 0, "digits": 1}, "either levels or colors"),
    ({"code": "kary", "axis": "row", "base": 2, "digit": 0, "digits": 1, "levels": [0, 1], "colors": [[1, 0, 0], [0, 1, 0]]},
     "either"),
    ({"code": "kary", "axis": "row", "base": 3, "digit": 0, "digits": 1, "levels": [0, 1]}, "levels has 2 entries, base is 3"),
    ({"code": "kary", "axis": "row", "base": 2, "digit": 0, "digits": 1, "levels": [0, 1.5]}, "levels"),
    ({"code": "ramp", "axis": "row", "direction": "left"}, "direction"),
    ({"code": "phase", "axis": "row", "period_px": 20, "step": 3, "steps": 3}, "step 3 does not exist"),
    ({"code": "phase", "axis": "row", "period_px": 20, "step": 0, "steps": 2}, "steps"),
    ({"code": "phase", "axis": "row", "period_px": 0, "step": 0, "steps": 3}, "period_px"),
    ({"code": "white", "axis": "row"}, "axis"),
])
def test_impossible_patterns_are_refused(data, words):
    with pytest.raises(ValidationError, match=words):
        TypeAdapter(Pattern).validate_python(data)


def test_a_black_stripe_is_a_colour():
    colors = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    data = {"code": "kary", "axis": "row", "base": 3, "digit": 0, "digits": 1, "colors": colors}
    pattern = TypeAdapter(Pattern).validate_python(data)
    assert pattern.colors == ((0, 0, 0), (1, 0, 0), (0, 1, 0))
