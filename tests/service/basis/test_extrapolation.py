"""Directions that viewers of RTI files offer where no light was captured."""

import numpy as np
import pytest

from service.basis.basis import extrapolation_sentences


def dome(lowest, count=48):
    """[lights, 3] unit directions on a spiral from the view axis to a lowest z."""
    z = 1 - (1 - lowest) * (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    around = np.sqrt(1 - z**2)
    return np.stack([around * np.cos(turn), around * np.sin(turn), z], axis=1)


@pytest.mark.parametrize(("lights", "said"), [
    (dome(0.2), None), (dome(0.35), None), (dome(0.35, 24), None), (dome(0.75), "37 %"), (dome(0.2)[dome(0.2)[:, 0] > 0], "31 %")])
def test_light_far_from_every_lamp_is_said(lights, said):
    """The cap of 41° + 30° leaves cos 71° of the hemisphere, a third, and what lies between the last lamps."""
    found = extrapolation_sentences(lights)
    assert found == [] if said is None else len(found) == 1 and said in found[0]
