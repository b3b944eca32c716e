"""Turns shared by whole columns: the same sums as one frame at a time, and fewer searches for the lights."""

import numpy as np
import pytest

from kernels.relight.directions.latlong import shared_turns
from service.relight.weights.weighting import integrate
from service.requests.relight import LightWeights
from stage.transforms import rotation_about, rotation_about_y
from tests.kernels.scenes import cap

SKY = np.random.default_rng(8).random((36, 72, 3))
"""Cut into 720 columns of half a degree."""
SUM = 1e-5
"""Of float32 cosines, which tell a border's place to that part of a sample."""


def spin(frames, degrees=360.0):
    return np.stack([rotation_about_y(degrees * frame / frames) for frame in range(frames)])


@pytest.mark.parametrize(("rotations", "searches"), [
    (spin(24), 1), (spin(48), 1), (spin(100), 5), (spin(7), 7), (np.stack([rotation_about_y(d) for d in (-400, 10.25, 0.75, 5.5)]), 2),
    (np.stack([rotation_about((1.0, 0.0, 0.0), d) for d in (0, 5, 10)]), 3),
])
def test_turns_by_whole_columns_are_found_once(rotations, searches):
    turns = list(shared_turns(rotations, 720))
    assert len(turns) == searches
    assert sorted(frame for turn in turns for frame in turn.frames) == list(range(len(rotations)))
    for turn in turns:
        for frame, columns in zip(turn.frames, turn.columns, strict=True):
            assert np.allclose(rotation_about_y(columns * 0.5) @ turn.rotation, rotations[frame], atol=1e-8)


@pytest.mark.parametrize("weighting", list(LightWeights))
def test_shared_turns_give_the_sums_of_single_ones(weighting, device):
    rotations, lights = spin(48), cap(40, 180)
    whole = integrate(SKY, lights, rotations, weighting=weighting, device=device)
    for frame in (0, 1, 5, 24, 47):
        single = integrate(SKY, lights, rotations[frame][None], weighting=weighting, device=device)
        assert np.allclose(whole[frame], single[0], rtol=0, atol=SUM * single.max())
    assert np.allclose(whole.sum(axis=1), whole[0].sum(axis=0), rtol=1e-12)
