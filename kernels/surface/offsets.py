"""How far the parts of a surface stand in front of one another, from the cast shadows that readings show.

An offset of a part is judged by the log-likelihood of all readings: log(1 + H (e^q - 1)), where q are the log odds that the reading lies in
shadow and H is the probability that the surface at that offset hides the light: 1 where the ray passes through the visible front, and less
where it is behind it all along its way. H is a step function of the offset with three steps (part_shadows.py), so one pass over the
readings gives the likelihood at all offsets.

Neighbouring readings err alike: the shape of a part errs, and highlights and bounced light are not known exactly. So neither the curvature
of the likelihood nor its height can be taken at face value. The lights are divided into groups by their direction, each of which throws
shadows on other places. The offset is left open between all values that the groups together do not contradict by twice the standard error
between them, and σ is at least that of leaving a group out in turn (the jackknife of Quenouille and Tukey).
"""

from typing import NamedTuple

import numpy as np

from kernels.surface.part_shadows import NO_GAP, PartShadows

INSIDE, BEHIND = 0.6, 0.4
"""Probability that a ray is hidden which lies behind the front of a part all along its way: before the guessed back, and behind it."""
GROUPS = 8
"""Groups of lights, by their direction about the line of sight."""
STEPS = 1024
"""Offsets that are compared on each side of 0."""
LEAST_GAIN = 3.0
"""Log-likelihood, beyond twice its standard error between groups, by which an offset must be worse to be ruled out."""
ERRORS = 2.0
"""Standard errors by which it must be worse."""


class Evidence(NamedTuple):
    """Log-likelihood of every compared offset of one part."""

    offsets: np.ndarray  # [m] in the unit of the gaps
    gain: np.ndarray  # [groups, m] log-likelihood of each group of lights, less that of offset 0


class Offset(NamedTuple):
    """An offset with its uncertainty."""

    offset: float
    sigma: float
    low: float
    high: float
    """Bounds of the offsets that are not ruled out; the ends of the compared range where it is open."""


def weigh_offsets(shadows: PartShadows, odds: np.ndarray, on_part: np.ndarray, group: np.ndarray, *, reach: float,
                  blur: float) -> Evidence:
    """Return the likelihood of offsets between -reach and reach. Waits for the device.

    Args:
        shadows: of n pixels and some lights.
        odds: [n, lights] log odds of shadow.
        on_part: [n] bool, whether the pixel lies on the part that moves.
        group: [lights] int, the group of each light, below GROUPS.
        reach: largest offset that is compared, in the unit of the gaps.
        blur: standard deviation of the gaps, in the same unit.
    """
    highest, hidden = shadows.highest.numpy(), shadows.hidden.numpy()
    told = (highest > NO_GAP) & (hidden == 0) & (odds != 0)
    gaps = [highest[told], shadows.lowest.numpy()[told], shadows.back.numpy()[told]]
    mine = np.broadcast_to(on_part[:, None], told.shape)[told]
    whose = np.broadcast_to(group[None], told.shape)[told]
    # a part that nears comes before others' pixels: free, hidden, then these lie behind its front, then behind its back; its own pixels
    # go the other way round
    levels = [np.log(1 + share * np.expm1(odds[told])) for share in (0.0, 1.0, INSIDE, BEHIND)]
    count = 2 * STEPS + 1
    change = np.zeros((GROUPS, count + 1))
    np.add.at(change, (whose, np.zeros_like(whose)), np.where(mine, levels[-1], levels[0]))
    for gap, before, after in zip(gaps, levels[:-1], levels[1:], strict=True):
        np.add.at(change, (whose, _bin(np.where(mine, gap, -gap), reach)), np.where(mine, before - after, after - before))
    gain = _blurred(np.cumsum(change, axis=1)[:, :count], blur / reach * STEPS)
    return Evidence(np.linspace(-reach, reach, count), gain - gain[:, STEPS, None])


def choose_offset(evidence: Evidence, *, least_sigma: float) -> Offset:
    """Return the offset that the evidence speaks for, and between which bounds it stays open.

    Args:
        evidence: of one part.
        least_sigma: standard deviation below which no offset is known.
    """
    offsets, gain = evidence
    whole = gain.sum(axis=0)
    best = int(np.argmax(whole))
    loss = gain[:, best, None] - gain
    # groups that see nothing of the part neither confirm nor contradict
    telling = max(2, int((np.ptp(gain, axis=1) > LEAST_GAIN / GROUPS).sum()))
    error = np.sqrt(((loss - loss.sum(axis=0) / telling) ** 2 * (np.ptp(gain, axis=1) > LEAST_GAIN / GROUPS)[:, None]).sum(axis=0)
                    * telling / (telling - 1))
    open_still = loss.sum(axis=0) < ERRORS * error + LEAST_GAIN
    low, high = offsets[np.flatnonzero(open_still)[[0, -1]]]
    apart = np.array([offsets[int(np.argmax(whole - one))] for one in gain])
    jackknife = float(np.sqrt((len(apart) - 1) / len(apart) * ((apart - apart.mean()) ** 2).sum()))
    return Offset(float(offsets[best]), max(jackknife, float(high - low) / (2 * ERRORS), least_sigma), float(low), float(high))


def _bin(offset: np.ndarray, reach: float) -> np.ndarray:
    """Return the first compared offset that is not below these."""
    return np.clip(np.ceil((offset / reach + 1) * STEPS), 0, 2 * STEPS + 1).astype(int)


def _blurred(values: np.ndarray, width: float) -> np.ndarray:
    """Return the values blurred by a Gaussian along the last axis, its ends continued."""
    half = int(np.ceil(3 * width))
    if half == 0:
        return values
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / width) ** 2)
    kernel /= kernel.sum()
    padded = np.pad(values, ((0, 0), (half, half)), mode="edge")
    return np.stack([np.convolve(row, kernel, mode="valid") for row in padded])
