"""What lights in front of the object reach, against closed forms."""

import numpy as np
import pytest

from service.captures.info import front_lights


def ring(degrees: float, count: int) -> np.ndarray:
    turn, tilt = 2 * np.pi * np.arange(count) / count, np.radians(degrees)
    return np.column_stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.full(count, np.cos(tilt))])


def test_angles_and_shares():
    found = front_lights(np.vstack([ring(30, 12), ring(60, 12)]))
    assert found.widest_deg == pytest.approx(60) and found.highlight_deg == pytest.approx(30)
    assert found.elsewhere == pytest.approx(0.75)  # of the sphere beyond a cone of 60 degrees
    assert found.dark == 0  # the half ring on the side of a normal faces it
    assert front_lights(np.vstack([ring(30, 5), [[1, 0, 0]]])) is None
    assert front_lights(ring(120, 5)) is None and front_lights(np.zeros((0, 3))) is None


def test_normals_that_three_lights_do_not_face():
    found = front_lights(ring(80, 3))
    z = np.random.default_rng(0).uniform(0, 1, (100_000, 1))
    turn = np.random.default_rng(1).uniform(0, 2 * np.pi, (100_000, 1))
    normals = np.hstack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    dark = ((normals @ ring(80, 3).T > 0).sum(axis=1) < 3).mean()
    assert found.dark == pytest.approx(dark, abs=0.01)  # the standard error of the random normals is 0.002
    assert f"{100 * found.dark:.0f} % of the directions" in found.sentence()
