"""Means, contrast and bends against closed forms."""

import numpy as np

from service.depth.stereo.neighbourhood import WINDOW_REACH, bend, box_mean, contrast


def test_means_and_contrast():
    image = np.random.default_rng(0).random((20, 30))
    mean = box_mean(image, 2)
    assert abs(mean[7, 9] - image[5:10, 7:12].mean()) < 1e-12
    assert abs(mean[0, 0] - np.pad(image, 2, mode="edge")[:5, :5].mean()) < 1e-12
    frames = np.stack([image, 3 * image + 100]).astype(np.float32)  # an offset has no contrast
    expected = np.sqrt((1 + 9) / 2) * image[5:10, 7:12].std()
    assert abs(contrast(frames, 2)[7, 9] - expected) < 1e-4 * expected


def test_a_bend_is_what_a_plane_of_least_squares_lies_above_the_surface():
    y, x = np.mgrid[:40, :50].astype(float)
    surface = 12 + 0.1 * x - 0.05 * y + 0.5 * 0.02 * (x - 25) ** 2 + 0.5 * -0.008 * (y - 20) ** 2
    dy, dx = np.mgrid[-WINDOW_REACH:WINDOW_REACH + 1, -WINDOW_REACH:WINDOW_REACH + 1]
    columns = np.stack([np.ones(dx.size), dx.ravel(), dy.ravel()], axis=-1)
    window = surface[20 - WINDOW_REACH:21 + WINDOW_REACH, 25 - WINDOW_REACH:26 + WINDOW_REACH].ravel()
    above = np.linalg.lstsq(columns, window, rcond=None)[0][0] - surface[20, 25]
    usable = np.ones(surface.shape, bool)
    found = bend(surface, usable)
    assert abs(found[20, 25] - above) < 1e-9 and abs(above - (0.02 - 0.008) / 2 * 20 / 3) < 1e-9
    step = np.where(x > 24, surface + 30, surface)
    beside = np.r_[8:18, 32:42]
    assert np.abs(bend(step, usable) - above)[8:-8, beside].max() < 1e-9 and np.abs(bend(step, usable)).max() < 0.1  # a step is no bend
    assert not bend(surface, np.zeros_like(usable)).any()
