"""Dark pixels that are decoded with their dark neighbours: more of them right, as sure as they say, and nothing where there is no light."""

import numpy as np

from kernels.tof.continuous.continuous import Noise, decode
from kernels.tof.continuous.pool import pool
from kernels.tof.continuous.unwrap import unwrap
from tests.reference import tof

HZ = (30e6, 90e6)
SETTINGS = tof.even(HZ, 4)
FAR = 4.99
NOISE = Noise(1.0, 5.0)


def phases(images, device):
    hz, delta = (np.array(column) for column in zip(*SETTINGS, strict=True))
    return decode(images.reshape(len(SETTINGS), -1).astype(np.float32), hz, delta, noise=NOISE, device=device)


def ranges(found, pixels):
    weighed = unwrap(found, nearest_m=0.0, farthest_m=FAR, light_speed=tof.LIGHT)
    return weighed.range.numpy()[0, :pixels], weighed.sigma.numpy()[:pixels]


def tilted(rows=60, cols=60, albedo=0.03):
    """A plane that recedes by 1 cm a pixel."""
    distance = 2.0 + 0.01 * np.arange(cols) + 0.004 * np.arange(rows)[:, None]
    return tof.View(distance, np.full(distance.shape, albedo), np.ones(distance.shape))


def test_dark_pixels_are_decoded_together(device):
    view = tilted()
    found = phases(tof.correlations(view, 4000, SETTINGS, ambient=40, seed=1), device)  # 20 electrons of signal over a noise of 10
    pooled, reach = pool(found, 60, 60, light_speed=tof.LIGHT)
    dark = reach.numpy()[:3600] > 0
    assert dark.mean() > 0.5
    truth = view.distance.ravel()
    (alone, _), (together, sigma) = ranges(found, 3600), ranges(pooled, 3600)
    within = [np.mean(np.abs(values - truth)[dark] < 0.05) for values in (alone, together)]
    assert within[1] > 1.5 * within[0]
    share = np.abs(together - truth)[dark] / sigma[dark]
    assert 0.7 < np.median(share) / 0.6745 < 1.4 and np.mean(share > 5) < 0.01
    np.testing.assert_array_equal(alone[~dark], together[~dark])  # pixels with a signal are not touched


def test_where_there_is_no_light_there_is_no_estimate(device):
    nothing = tof.View(np.full((150, 200), 3.0), np.zeros((150, 200)), np.ones((150, 200)))
    _, reach = pool(phases(tof.correlations(nothing, 1e5, SETTINGS, ambient=300, seed=2), device), 150, 200, light_speed=tof.LIGHT)
    assert np.count_nonzero(reach.numpy()) <= 9  # three windows of one false signal in a million, whose windows overlap


def test_a_bright_object_does_not_light_the_dark_beside_it(device):
    albedo = np.zeros((40, 40))
    albedo[:, :20] = 0.9
    scene = tof.View(np.full((40, 40), 2.0), albedo, np.ones((40, 40)))
    found = phases(tof.correlations(scene, 1e5, SETTINGS, ambient=300, seed=3), device)
    reach = pool(found, 40, 40, light_speed=tof.LIGHT).reach.numpy()[:1600].reshape(40, 40)
    assert not reach.any()
