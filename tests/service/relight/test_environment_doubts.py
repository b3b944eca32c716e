"""Environment maps whose light is another one where they are used: colours outside of the gamut, and too few rows."""

import numpy as np
import pytest

from service.relight.environments import Environments
from tests.scenes.captures import write_exr

REC709 = "lin_rec709_scene"


def doubts(folder, colour, rows=32, space=REC709):
    environments = Environments(write_exr(folder / "sky.exr", np.broadcast_to(colour, (rows, 2 * rows, 3)), colorInteropID=space))
    radiance = environments.read(folder / "sky.exr", REC709).radiance
    return radiance, environments


@pytest.mark.parametrize(("colour", "part"), [((0.1, 0.6, 0.2), 0.02), ((0.3, 0.5, 0.4), 0.0)])
def test_colours_outside_of_the_gamut_are_said(tmp_path, colour, part):
    """A green of ACEScg has less than no red in Rec.709; it was set to 0, and the light was another one, without a word."""
    radiance, environments = doubts(tmp_path, colour, space="lin_ap1_scene")
    added = environments.outside["sky.exr"]
    assert radiance.min() >= 0 and (added > part if part else added == 0)
    assert [f"adds {100 * added:.2g} %" in sentence for sentence in environments.doubts()] == [True] * (part > 0)


@pytest.mark.parametrize(("rows", "words"), [(1, "57 % too bright"), (4, "2.6 % too bright"), (16, None), (32, None)])
def test_too_few_rows_are_said(tmp_path, rows, words):
    """Truth: (π/2n) / sin(π/2n), the sum of the rows' solid angles over 4π."""
    found = doubts(tmp_path, (1.0, 1.0, 1.0), rows)[1].doubts()
    assert [words in sentence for sentence in found] == [True] if words else found == []
