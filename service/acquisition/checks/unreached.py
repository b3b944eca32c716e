"""Lamps that none of what is sent reaches: switched off, at another address, or behind another node."""

from collections.abc import Callable, Sequence

import numpy as np

from service.acquisition.checks.expectation import LEAST_LAMPS, LEAST_MISFIT, Fault, FaultKind, Seen, unit_root
from service.acquisition.plans.shots import Shot

RELATED = 0.15
"""Without a dark picture, one under a lamp shows no sign of it if its correlation with the mean of the others is less: that of noise over a
thousand blocks has a standard deviation of 0.03, whatever the exposure is."""
GLOW_GAIN = 2.0
"""A block reads more than in the dark if it is above it by more than this factor of the most that one is below it: noise is symmetric."""
DARKER = 0.9
"""Where pictures under lamps read less than this part of the dark one, that is the wrong one."""
ALIKE, UNEQUAL = 0.02, 0.1
"""Pictures under different lamps are of none of them if their light differs by less than the first part, and their shading by LEAST_MISFIT;
not where a flat card would look so, under lamps whose heights above it differ by less than the second."""

ADVICE = "are the lamps switched on, does what is sent reach them, and does nothing else drive them?"


def unreached_faults(pictures: Sequence[Seen], directions: np.ndarray, dark_of: Callable[[Shot], np.ndarray | float]) -> list[Fault]:
    """Return the faults of pictures under single lamps that show no sign of them, where most do; or of all, where all are alike.
    `directions`: [lamps, 3] unit vectors of the lamps of the rig. `dark_of`: the mean picture without any lamp at the exposure of a shot,
    [blocks]; 0 where there is none."""
    alone = [each for each in pictures if each.shot.lamp is not None]
    dark: dict[tuple[str, float | None], np.ndarray | float] = {}
    for each in alone:
        place = each.shot.folder, each.shot.exposure_s
        if place not in dark:
            dark[place] = dark_of(each.shot)
    if any(isinstance(found, float) for found in dark.values()):
        shines = _related(alone) if len(dark) == 1 else [True] * len(alone)
    else:
        shines = [glows(each, dark[each.shot.folder, each.shot.exposure_s]) for each in alone]
        darker = [each.sample.blocks.mean() < DARKER * np.mean(dark[each.shot.folder, each.shot.exposure_s]) for each in alone]
        if 2 * sum(darker) > len(alone):
            return []
    shine: dict[int | None, bool] = {}
    for each, shining in zip(alone, shines, strict=True):
        shine[each.shot.lamp] = shine.get(each.shot.lamp, False) or shining
    if 2 * sum(shine.values()) < len(shine):
        return [Fault(each.shot.key, FaultKind.UNLIT, f"shows no sign of the lamp, as most pictures: {ADVICE}")
                for each in alone if not shine[each.shot.lamp]]
    if len(shine) >= LEAST_LAMPS and len(dark) == 1 and np.ptp(directions[np.array(list(shine), int), 2]) > UNEQUAL:
        light = np.array([each.sample.blocks.mean() for each in alone])
        mean = unit_root(np.mean([each.sample.blocks for each in alone], axis=0))
        if np.ptp(light) < ALIKE * light.mean() and max(1 - float(each.root @ mean) for each in alone) < LEAST_MISFIT:
            return [Fault(each.shot.key, FaultKind.UNLIT, f"is like those under all other lamps: {ADVICE}") for each in alone]
    return []


def glows(seen: Seen, dark: np.ndarray | float) -> bool:
    """Return whether a picture reads more than the dark one somewhere; False without a dark one."""
    return not isinstance(dark, float) and shows(seen, dark, float((seen.sample.blocks - dark).max()))


def shows(seen: Seen, dark: np.ndarray, light: float) -> bool:
    """Return whether a block of so much light would stand out from the noise of a picture."""
    return light > GLOW_GAIN * -float((seen.sample.blocks - dark).min())


def _related(pictures: Sequence[Seen]) -> list[bool]:
    """Return whether each picture shows what the mean of the others does; all of them where there are few."""
    if len(pictures) < LEAST_LAMPS:
        return [True] * len(pictures)
    blocks = np.array([each.sample.blocks for each in pictures])
    others = (blocks.sum(axis=0) - blocks) / (len(blocks) - 1)
    blocks, others = (each - each.mean(axis=1, keepdims=True) for each in (blocks, others))
    size = np.linalg.norm(blocks, axis=1) * np.linalg.norm(others, axis=1)
    return list(((blocks * others).sum(axis=1) >= RELATED * size).tolist())
