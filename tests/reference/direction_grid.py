"""Slow float64 twin of light spread over rings of directions by cubic convolution; it imports nothing of ours."""

import numpy as np


def keys(distance):
    """Keys' kernel with a = -1/2 at a distance in steps."""
    s = abs(distance)
    if s < 1:
        return 1.5 * s**3 - 2.5 * s**2 + 1
    return -0.5 * s**3 + 2.5 * s**2 - 4 * s + 2 if s < 2 else 0.0


def cubic_spread(samples, energy, columns):
    """[D, channels]: each sample to its neighbours on rings about +y, columns [rings] directions each, the first half a step from -z."""
    rings = len(columns)
    first = np.concatenate([[0], np.cumsum(columns)])
    total = np.zeros((first[-1], energy.shape[1]))
    for sample, amount in zip(samples, energy, strict=True):
        polar = np.arccos(np.clip(sample[1], -1, 1))
        azimuth = np.arctan2(sample[0], -sample[2])
        for ring in range(-2, rings + 2):  # those beyond a pole lie on the other side of it
            across = keys((polar - np.pi * (ring + 0.5) / rings) / (np.pi / rings))
            if across == 0:
                continue
            over = not 0 <= ring < rings
            real = -1 - ring if ring < 0 else 2 * rings - 1 - ring if over else ring
            step = 2 * np.pi / columns[real]
            place = azimuth + np.pi * over
            nearest = int(np.floor(place / step))
            for column in range(nearest - 3, nearest + 4):
                along = keys((place - (column + 0.5) * step) / step)
                total[first[real] + column % columns[real]] += across * along * amount
    return total
