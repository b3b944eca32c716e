"""Lights that disagree with the others: found by how far their readings are off, and not where there is nothing to compare."""

import numpy as np
import pytest

from service.light_estimation.suspects import suspects
from tests.scenes.captures import ring

RNG = np.random.default_rng(3)
TILT = np.radians(RNG.uniform(0, 40, 300))
TURN = RNG.uniform(0, 2 * np.pi, 300)
NORMAL = np.stack([np.sin(TILT) * np.cos(TURN), np.sin(TILT) * np.sin(TURN), np.cos(TILT)])
LIGHTS = ring(10)
LEVEL = RNG.uniform(0.2, 0.8, 300)
READINGS = LEVEL * np.maximum(LIGHTS @ NORMAL, 0)


def test_consistent_lights_are_no_suspects():
    noisy = READINGS * (1 + 0.02 * RNG.standard_normal(READINGS.shape))
    assert suspects(READINGS, LIGHTS, NORMAL) == [] and suspects(noisy, LIGHTS, NORMAL) == []


def test_a_light_of_another_strength_is_found_with_its_misfit():
    off = READINGS.copy()
    off[3] *= 1.5
    off[7] *= 0.7
    found = suspects(off, LIGHTS, NORMAL)
    assert [each.light for each in found] == [3, 7]
    assert [each.misfit for each in found] == pytest.approx([0.5, 0.3], abs=1e-9)  # the median over lights is the level


def test_lights_that_few_pixels_see_are_not_judged():
    assert suspects(READINGS[:, :10] * 2, LIGHTS, NORMAL[:, :10]) == []
    behind = LIGHTS * [1, 1, -1]
    assert suspects(READINGS, behind, NORMAL) == []
