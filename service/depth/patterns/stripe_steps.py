"""Steps between the stripes of neighbouring pixels: under the right order of bits or digits they follow each other."""

from typing import NamedTuple

import numpy as np

CLEAR_BIT, CLEAR_SIGMAS = 0.4, 4.0
"""A bit is read where its contrast is this part of the largest of the pixel's bits, and this many deviations."""
READ_SHARE = 0.5
"""Finer bits than the first that fewer of the pixels read are left out."""
REACH = 3
"""Largest distance in pixels of two pixels of a row whose stripes are compared."""
JUMP = 4.0
"""Steps between neighbours, in the usual number of stripes, from which on they are jumps."""
SHORTER, NO_LONGER = 0.8, 0.98
"""The mean logarithm of the steps of another order, over that of the declared one, below which it is named, and below which it is where it
mends jumps too."""
PLACES, AT_A_PLACE, OF_STEPS = 3, 8, 0.01
"""Number of places of the code at which another order of bits mends jumps, of image rows in which it does so at each, and least part of the
steps, from which on that order is named. An edge of depth jumps between other stripes in every row."""
MENDED = 5.0
"""Jumps that another order mends over those that it makes."""
BEYOND_SHARE = 0.02
"""Share of the neighbours whose stripes lie beyond the projector, side by side, from which on its size is doubted."""


class Pairs(NamedTuple):
    """Pixels of a row that lie near each other."""

    first: np.ndarray  # [pairs] index into the flat sample
    second: np.ndarray  # [pairs]
    row: np.ndarray  # [pairs]

    @classmethod
    def of(cls, known: np.ndarray) -> "Pairs":
        """Return each pixel with the next of its row that is known, if it is near."""
        width = known.shape[1]
        at = np.flatnonzero(known)
        near = (at[1:] - at[:-1] <= REACH) & (at[1:] // width == at[:-1] // width)
        return cls(at[:-1][near], at[1:][near], at[1:][near] // width)

    def steps(self, numbers: np.ndarray) -> np.ndarray:
        """Return the distance of their stripes, [pairs]."""
        flat = numbers.ravel()
        return np.asarray(np.abs(flat[self.second] - flat[self.first]))


def mends(numbers: np.ndarray, pairs: Pairs, declared: np.ndarray, jumps: np.ndarray, count: float, *, outside: bool) -> float | None:
    """Return the mean logarithm of the steps under other numbers of the stripes over that under the declared ones, if the stripes follow
    each other much better so; else None.
    `declared`: [pairs] steps as declared, and `jumps` among them. `count`: number of stripes that the projector shows. `outside`:
    whether stripes lie beyond the projector as declared."""
    steps, flat = pairs.steps(numbers), numbers.ravel()
    if (flat[pairs.first] >= count).mean() > BEYOND_SHARE or not steps.any():
        return None
    part = float(np.log2(1 + steps).sum() / np.log2(1 + declared).sum())
    if part < SHORTER:
        return part
    usual = max(float(np.median(steps[steps > 0])), 1.0)
    mended, made = jumps & (steps <= 2 * usual), ~jumps & (steps > JUMP * usual)
    if part > NO_LONGER or mended.sum() < max(MENDED * made.sum(), OF_STEPS * (declared > 0).sum()) or jumps.sum() > 2 * mended.sum():
        return None
    place = (flat[pairs.first] + flat[pairs.second])[mended] // int(4 * usual)
    rows = [len(np.unique(pairs.row[mended][place == key])) for key in np.unique(place)]
    return part if sum(number >= AT_A_PLACE for number in rows) >= PLACES - outside else None
