"""Plans against what their shots must be."""

import numpy as np
import pytest

from service.acquisition.plans.plan import Plan
from service.acquisition.plans.shots import TRACKING, shots_of
from service.errors import RequestError
from tests.service.acquisition.scenes import Scene, rig_of

DIRECTIONS = np.array([[0, 0, 1], [1, 0, 0], [0, 0.6, 0.8], [-1, 0, 0.0]])
RIG = rig_of(Scene(np.zeros(0), DIRECTIONS))


def shots(*sequences: dict, **fields):
    return shots_of(Plan.model_validate({"schema": "relit.plan/1", "sequences": sequences, **fields}), RIG, None)


def test_gradients_have_the_levels_of_the_closed_form():
    found = shots({"take": "gradients", "polarization": "cross"})
    expected = [(1 + sign * DIRECTIONS[:, axis]) / 2 for axis in range(3) for sign in (1, -1)] + [np.ones(4)]
    assert np.allclose([shot.levels for shot in found], expected, atol=1e-12)
    assert [(shot.light.axis, shot.light.sign) for shot in found[:3]] == [("x", 1), ("x", -1), ("y", 1)]
    assert {shot.light.polarization for shot in found} == {"cross"}


def test_each_lamp_alone_at_each_exposure_with_tracking_between():
    found = shots({"take": "olat", "lights": ["L2", "L0", "L3"], "level": 0.5, "exposures_s": [0.1, 0.4], "prompt": "wait"},
                  tracking_every=2)
    olat = [shot for shot in found if shot.lamp is not None]
    assert [(shot.lamp, shot.exposure_s) for shot in olat] == [(lamp, time) for lamp in (2, 0, 3) for time in (0.1, 0.4)]
    assert all(np.array_equal(shot.levels, 0.5 * (np.arange(4) == shot.lamp)) for shot in olat)
    assert np.allclose(olat[0].light.direction, DIRECTIONS[2]) and np.allclose(olat[0].light.irradiance, 0.5)
    assert [shot.name.endswith(TRACKING) for shot in found] == [True, False, False, False, False, True, False, False, True]
    assert [shot.prompt for shot in found] == ["wait"] + 8 * [None]
    assert len({shot.key for shot in found}) == len(found)


@pytest.mark.parametrize(("sequences", "words"), [
    ([{"take": "olat", "lights": ["L9"]}], "no lamp L9"), ([{"take": "patterns", "code": "gray"}], "--projector"),
    ([{"take": "flat"}, {"take": "flat"}], "several flat")])
def test_what_cannot_be_taken_is_refused(sequences, words):
    with pytest.raises(RequestError, match=words):
        shots(*sequences)
