"""Albedo from the energy of a sweep: known texture back, and nothing where the sweep does not tell."""

import numpy as np
import pytest

from service.depth.laser.stripes import Signal, Sweep

RNG = np.random.default_rng(0)
ALBEDO = np.exp(RNG.normal(0, 0.4, (40, 120)))


def swept(step, *, width=1.6, noise=0.0, albedo=ALBEDO, first=10.0, last=110.0):
    sweep, cols = Sweep(), np.arange(albedo.shape[1]) + 0.5
    for place in np.arange(first, last, step):
        frame = albedo * np.exp(-((cols - place) ** 2) / (2 * width**2)) + RNG.normal(0, noise, albedo.shape)
        last_frame = Signal(frame.astype(np.float32), 0, max(noise, 1e-5))
        sweep.add(last_frame)
    sweep.close()
    return sweep.albedo_for(last_frame)


@pytest.mark.parametrize("step", [0.7, 1.5])
def test_texture_is_found_again(step):
    found = swept(step)
    inner = slice(18, 102)
    assert (found[:, inner] > 0).all()
    ratio = (found / ALBEDO)[:, inner]
    assert np.std(ratio) / np.mean(ratio) < 0.01  # the ripple of the sum
    assert (found[:, :8] == 0).all() and (found[:, 112:] == 0).all()  # beyond the sweep, and where its end takes half of the light


def test_stripes_that_lie_apart_tell_nothing():
    found = swept(8.0)
    assert found is None or np.mean(found > 0) < 0.01


def test_noise_is_not_taken_for_texture():
    found = swept(1.0, noise=0.01, albedo=np.ones((40, 120)))
    inner = found[:, 18:102]
    assert np.std(inner) / np.mean(inner) < 0.0045  # a reading's noise is 0.01 over a root energy of 1.7: a half is smoothed away


def test_one_frame_tells_nothing():
    sweep, frame = Sweep(), Signal(np.ones((4, 4), np.float32), 0, 0.01)
    sweep.add(frame)
    sweep.close()
    assert sweep.albedo_for(frame) is None
