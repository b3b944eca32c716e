"""Where the surface bends within what a pixel sees, its normal is less sure."""

import numpy as np

from kernels.photometric.search.certainty import MOST
from service.solve.inside_pixels import SPOT, unseen_bend

ROWS, COLS = 12, 30


def _wave(period: float, height: float) -> np.ndarray:
    """Return [3, ROWS, COLS] unit normals of which x is a wave along the columns."""
    across = np.broadcast_to(height * np.sin(2 * np.pi * np.arange(COLS) / period), (ROWS, COLS))
    return np.stack([across, np.zeros((ROWS, COLS)), np.sqrt(1 - across**2)])


def test_the_error_is_that_of_the_mean_over_the_spot():
    """A Gaussian spot of standard deviation b multiplies a wave of frequency w by exp(-b²w²/2), so that it takes off all but this part. The
    differences of neighbours are (2 - 2 cos w)/w² of the true ones, and the series stops at its first term: 4 % for a period of 12 pixels.
    The other component of the normal bends, too, by 0.0002°."""
    period, height = 12.0, 0.01
    found = unseen_bend(_wave(period, height), np.zeros((ROWS, COLS)), np.ones((ROWS, COLS), bool))
    frequency = 2 * np.pi / period
    lost = np.degrees(height * (1 - np.exp(-((SPOT * frequency) ** 2) / 2)) * np.abs(np.sin(frequency * np.arange(COLS))))
    np.testing.assert_allclose(found[1:-1, 1:-1], np.broadcast_to(lost, (ROWS, COLS))[1:-1, 1:-1], rtol=0.05, atol=0.0003)


def test_noise_bends_nothing():
    """Normals of a plane with an error of σ: what differences show beyond their noise is a tenth of σ in the mean; without taking the noise
    off it would be a half."""
    random, sigma = np.random.default_rng(0), 2.0
    slope = np.radians(sigma) / np.sqrt(2) * random.normal(size=(2, 200, 200))
    normal = np.stack([*slope, np.ones((200, 200))])
    normal /= np.linalg.norm(normal, axis=0)
    found = unseen_bend(normal, np.full((200, 200), sigma), np.ones((200, 200), bool))
    assert np.sqrt(np.mean(np.square(found[1:-1, 1:-1]))) < 0.35 * sigma
    assert np.sqrt(np.mean(np.square(unseen_bend(normal, np.zeros((200, 200)), np.ones((200, 200), bool))))) > 0.5 * sigma


def test_a_border_tells_nothing():
    solved = np.ones((ROWS, COLS), bool)
    solved[:, 15] = False
    normal = _wave(7.0, 0.3)
    normal[:, :, 15] = 0
    found = unseen_bend(normal, np.zeros((ROWS, COLS)), solved)
    assert not found[:, [0, 14, 15, 16, -1]].any() and (found[:, 2:13] > 0).any()


def test_the_size_of_pieces_changes_nothing(monkeypatch):
    random = np.random.default_rng(1)
    normal = random.normal(size=(3, ROWS, COLS))
    normal /= np.linalg.norm(normal, axis=0)
    solved, sigma = random.random((ROWS, COLS)) < 0.9, random.random((ROWS, COLS))
    whole = unseen_bend(normal, sigma, solved)
    monkeypatch.setattr("service.solve.inside_pixels.BAND_PIXELS", 2 * COLS)
    np.testing.assert_array_equal(unseen_bend(normal, sigma, solved), whole)


def test_what_is_hardly_known_gets_no_worse():
    """Normals at random, of every σ up to the largest."""
    random = np.random.default_rng(2)
    normal = random.normal(size=(3, ROWS, COLS))
    sigma = MOST * random.random((ROWS, COLS))
    found = unseen_bend(normal / np.linalg.norm(normal, axis=0), sigma, np.ones((ROWS, COLS), bool))
    assert 0.999 * MOST < np.hypot(found, sigma).max() < 1.001 * MOST  # float32
