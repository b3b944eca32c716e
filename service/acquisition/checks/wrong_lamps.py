"""Pictures under another lamp than the plan says: one that shone twice, or two that are exchanged."""

from collections.abc import Iterator, Sequence

import numpy as np

from service.acquisition.checks.expectation import LEAST_LAMPS, LEAST_MISFIT, Expectation, Fault, FaultKind, Seen, unit_root

SAME_PART = 0.15
"""Two pictures are of one light if they differ by less than this part of what the third nearest picture differs by."""
NEIGHBOURS, NEIGHBOUR_WEIGHT = 8, 4.0
"""The neighbours of either lamp whose predictions tell which of them shone, and how much the logarithm of what they misfit counts: their
pictures are right, and there are several."""
NEAR_COSINE = 0.3
"""Lamps within this cosine of one another light the same sides of an object, so that their pictures differ with the angle between them."""
EXCHANGED_PART = 0.04
"""The product of the parts of their misfits that pictures of two exchanged lamps keep in each other's place. Of 45 right captures (the owl,
the cat and the ball of DiLiGenT, reliefs under 10 to 84 lamps) the least is 0.58, of 118 with other faults 0.045; of exchanged lamps nine
in ten are below."""
LEAST_LIGHT = 0.2
"""The part of the mean light of a lamp below which nothing is said of it."""


def twin_of(seen: Seen, others: list[Seen], expectation: Expectation) -> str | None:
    """Return the key of another lamp's picture that is of the same light and fits there better than this one does here.

    Three things tell which of both lamps shone: what the others predict of either, what the picture at either place predicts of its
    neighbours, and that pictures differ the more, the farther apart their lamps are.
    """
    others = [each for each in others if each.shot.lamp != seen.shot.lamp]  # a plan may light a lamp more than once
    if len(others) < LEAST_LAMPS:
        return None
    differ = 1 - np.array([each.root for each in others]) @ seen.root
    order = np.argsort(differ)
    if differ[order[0]] > SAME_PART * differ[order[2]]:
        return None
    both, rest = (seen, others[order[0]]), [others[index] for index in order[1:]]
    cosines = expectation.towards(rest) @ expectation.towards(list(both)).T
    near = [rest[index] for index in np.argsort(-cosines.max(axis=1))[:NEIGHBOURS]]
    around = np.array([[expectation.misfit(one, [*(other for other in rest if other is not one), each]) for each in both]
                       for one in near])
    around = around[(around > 0).all(axis=1)].sum(axis=0)  # a misfit of 0: nothing was expected
    misfits = [expectation.misfit(each, rest) for each in both]
    worse = [np.log(max(misfit, LEAST_MISFIT)) + NEIGHBOUR_WEIGHT * np.log(max(beside, LEAST_MISFIT))
             - _agreement(differ[order[1:]], column) for misfit, beside, column in zip(misfits, around, cosines.T, strict=True)]
    return both[1].shot.key if worse[0] > worse[1] else None


def exchanged_faults(pictures: Sequence[Seen], expectation: Expectation) -> Iterator[Fault]:
    """Yield the faults of pictures under single lamps that are of each other's lamp, of each object and exposure by itself."""
    alike: dict[tuple[str, float | None], list[Seen]] = {}
    for each in pictures:
        if each.shot.lamp is not None:
            alike.setdefault((each.shot.folder, each.shot.exposure_s), []).append(each)
    for found in alike.values():
        yield from _exchanged(found, expectation)


def _exchanged(pictures: Sequence[Seen], expectation: Expectation) -> Iterator[Fault]:
    light = np.array([each.sample.blocks.mean() for each in pictures])
    if len(pictures) <= LEAST_LAMPS:
        return
    expected = []
    for place, each in enumerate(pictures):
        others = [*pictures[:place], *pictures[place + 1:]]
        shares = expectation.shares(each, others)
        if shares is None:
            light[place] = 0.0
        blocks = np.array([other.sample.blocks for other in others])
        expected.append(unit_root(each.sample.blocks if shares is None else np.maximum(shares @ blocks, 0)))
    misfit = np.maximum(1 - np.array([each.root for each in pictures]) @ np.array(expected).T, LEAST_MISFIT)  # of a picture at a place
    kept = misfit / misfit.diagonal()[:, None]
    pairs = kept * kept.T
    faint = light < LEAST_LIGHT * light.mean()
    pairs[faint] = pairs[:, faint] = 1.0
    while pairs.min() < EXCHANGED_PART:
        one, other = np.unravel_index(pairs.argmin(), pairs.shape)
        for index, twin in ((one, other), (other, one)):
            yield Fault(pictures[index].shot.key, FaultKind.WRONG_LIGHT, f"is lit as {pictures[twin].shot.key} should be, which is "
                        "lit as this: are both lamps exchanged in the rig, or at their addresses?")
            pairs[index] = pairs[:, index] = 1.0


def _agreement(differences: np.ndarray, cosines: np.ndarray) -> float:
    """Return the correlation of pictures' differences with the angles to their lamps, of those that are near."""
    near = cosines > NEAR_COSINE
    if near.sum() < 3:
        return -1.0
    return float(np.corrcoef(differences[near], np.arccos(np.minimum(cosines[near], 1)))[0, 1])
