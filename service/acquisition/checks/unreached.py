"""Lamps that none of what is sent reaches: switched off, at another address, or behind another node."""

from collections.abc import Callable, Sequence

import numpy as np

from service.acquisition.checks.expectation import LEAST_MISFIT, Seen, unit_root
from service.acquisition.checks.fault import Fault, FaultKind
from service.acquisition.checks.prediction import LEAST_LAMPS
from service.acquisition.plans.shots import Shot

FAINT = 0.003
"""A picture under a lamp shows no sign of it, where there is no dark one, if its brightest thousandth reads less of full scale."""
GLOW_GAIN = 2.0
"""A block reads more than in the dark if it is above it by more than this factor of the most that one is below it: noise is symmetric."""
ALIKE = 0.02
"""Pictures under different lamps are of none of them if their light differs by less than this part, and their shading by LEAST_MISFIT."""

ADVICE = "are the lamps switched on, and does what is sent reach them?"


def unreached_faults(pictures: Sequence[Seen], dark_of: Callable[[Shot], np.ndarray | float]) -> list[Fault]:
    """Return the faults of pictures under single lamps that show no sign of them, where most do; or of all, where all are alike.

    Args:
        dark_of: the mean picture without any lamp at the exposure of a shot, [blocks]; 0 where there is none.
    """
    alone = [each for each in pictures if each.shot.lamp is not None]
    shine: dict[int | None, bool] = {}
    for each in alone:
        dark = dark_of(each.shot)
        shines = each.sample.bright >= FAINT if isinstance(dark, float) else glows(each, dark)
        shine[each.shot.lamp] = shine.get(each.shot.lamp, False) or shines
    if 2 * sum(shine.values()) < len(shine):
        return [Fault(each.shot.key, FaultKind.UNLIT, f"shows no sign of the lamp, as most pictures: {ADVICE}")
                for each in alone if not shine[each.shot.lamp]]
    if len(shine) >= LEAST_LAMPS and len({(each.shot.folder, each.shot.exposure_s) for each in alone}) == 1:
        light = np.array([each.sample.blocks.mean() for each in alone])
        mean = unit_root(np.mean([each.sample.blocks for each in alone], axis=0))
        if np.ptp(light) < ALIKE * light.mean() and max(1 - float(each.root @ mean) for each in alone) < LEAST_MISFIT:
            return [Fault(each.shot.key, FaultKind.UNLIT, f"is like those under all other lamps: {ADVICE}") for each in alone]
    return []


def glows(seen: Seen, dark: np.ndarray | float) -> bool:
    """Return whether a picture reads more than the dark one somewhere; False without a dark one."""
    if isinstance(dark, float):
        return False
    above = seen.sample.blocks - dark
    return bool(above.max() > GLOW_GAIN * -above.min())
