"""Level and noise of a laser frame where there is neither stripe nor spot."""

import numpy as np

from stage.spread import MAD_TO_SIGMA

TIED = 0.05
"""Part of the readings that equal their median, from which on they are steps of a file of few bits."""
MOST = 0.9, 1.645
"""Part of the readings that is background, and within how many standard deviations it lies."""
FEWEST = 0.05
"""Part of the readings beside the median that may be smaller than a step."""


def background(values: np.ndarray, least: float) -> tuple[float, float]:
    """Return the median and the standard deviation of readings of a frame, [n], most of which are background; at least `least`.

    Where noise is smaller than the steps of the file, most readings are equal: then the steps are the noise, as of a difference of two
    such frames, and a reading that is a step higher is no light of the laser.
    """
    middle = float(np.median(values))
    away = np.abs(values - middle)
    noise = max(MAD_TO_SIGMA * float(np.median(away)), least)
    others = away[away > 0]
    if others.size and 1 - others.size / away.size > TIED:
        step = float(np.quantile(others, FEWEST))
        noise = max(noise, float(np.quantile(away, MOST[0])) / MOST[1], step / 6**0.5)
    return middle, noise
