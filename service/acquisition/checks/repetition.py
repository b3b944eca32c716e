"""Frames that repeat a plan, held against it: whether each is lit as the one a period before, and whether tracking frames are where the
plan has them."""

from collections.abc import Sequence

import numpy as np

from service.acquisition.plans.shots import TRACKING, Shot
from stage.capture.light import FullLight, GradientLight

CLOSER = 0.5
"""A frame is lit as another one that differs from it by less than this part of what the frame a period before does. A subject that moves
evenly differs from frames up to a third of a period nearer by two thirds of it or more."""
MOST_APART = 3
"""Frames up to this part of a period from the place of a frame are compared with it."""
LEAST_VOTES = 3
"""Number of frames, or a third of the period if that is more, that must agree by how much they are misplaced."""
LEAST_MISFIT, FULL_PART = 0.003, 0.4
"""A frame that is less unlike the mean of its period is lit by all lamps, as an image under a lamp beside the camera may seem to be. Frames
beside the places of tracking frames that are unlike it by less than the second part of what those in the places are, are the tracking
frames. One minus the cosine of both images."""
LEAST_TRACKING = 3
"""Number of consecutive places of tracking frames of which most must say so: in one of them a lamp may have failed."""
LEAST_LAMPS = 4
"""The fewest lamps whose mean is an image under full light."""
ALIKE = 1.5
"""The factor between the light of tracking frames of neighbouring periods; nearly all lamps light them."""
NEAR = 2
"""Number of periods before and after one whose tracking frames are its neighbours."""


def repetition_fault(blocks: np.ndarray, period: Sequence[Shot], names: Sequence[str]) -> str | None:
    """Return a sentence that says where frames do not repeat a plan, or None.

    Args:
        blocks: [frames, blocks] float, linear, the means of blocks of each frame.
        period: the shots of one period, whose first is that of the first frame.
        names: of the frames.
    """
    return (_misplaced(blocks, len(period), names) or _tracking_elsewhere(blocks, period, names)
            or _tracking_unlike(blocks, period, names))


def _misplaced(blocks: np.ndarray, count: int, names: Sequence[str]) -> str | None:
    """Return where frames are lit as others than those a period before."""
    reach = count // MOST_APART
    for begin in range(count, len(blocks), count):
        votes: dict[int, list[int]] = {}
        for frame in range(begin, min(begin + count, len(blocks))):
            before = range(max(0, frame - count - reach), min(frame, frame - count + reach + 1))
            apart = np.linalg.norm(blocks[before.start:before.stop] - blocks[frame], axis=1)
            nearest = int(apart.argmin())
            if apart[nearest] < CLOSER * apart[frame - count - before.start]:
                votes.setdefault(frame - before[nearest], []).append(frame)
        back, frames = max(votes.items(), key=lambda vote: len(vote[1]), default=(0, []))
        if len(frames) >= max(LEAST_VOTES, count // 3):
            return (f"{names[frames[0]]}: is lit as {names[frames[0] - back]}, {back} frames before it, and a period has {count}: "
                    "a frame was lost or doubled there, or the plan is not that of these frames")
    return None


def _tracking_elsewhere(blocks: np.ndarray, period: Sequence[Shot], names: Sequence[str]) -> str | None:
    """Return where another frame than the plan says is lit by all lamps."""
    count = len(period)
    if len({shot.lamp for shot in period if shot.lamp is not None}) < LEAST_LAMPS:
        return None
    lit = np.array([period[frame % count].levels.any() for frame in range(len(blocks))])
    full = np.array([_is_full(shot) for shot in period])
    unit = blocks / np.maximum(np.linalg.norm(blocks, axis=1, keepdims=True), 1e-30)
    misfit = np.zeros(len(blocks))
    for frame in range(len(blocks)):
        first = min(max(0, frame - count // 2), max(0, len(blocks) - count))
        mean = blocks[first:first + count][lit[first:first + count]].mean(axis=0)
        misfit[frame] = 1 - unit[frame] @ mean / max(float(np.linalg.norm(mean)), 1e-30)
    places = [frame for frame in range(len(blocks)) if _is_tracking(period[frame % count])]
    for first in range(len(places) - LEAST_TRACKING + 1):
        several = np.array(places[first:first + LEAST_TRACKING])
        unlike = {by: float(np.median(misfit[several + by])) for by in range(-(count // 2), count // 2 + 1)
                  if by == 0 or (several[0] + by >= 0 and several[-1] + by < len(blocks) and not full[(several + by) % count].any())}
        best = min(unlike, key=unlike.__getitem__)
        if unlike[0] > LEAST_MISFIT and unlike[best] < FULL_PART * unlike[0]:
            frame = next((place for place in several if misfit[place + best] < FULL_PART * misfit[place]), several[0])
            return (f"{names[frame]}: should be a tracking frame, and does not look like one as others do: the first period begins with "
                    "another frame (--frames), a frame was lost or doubled, or the plan is not that of these frames")
    return None


def _tracking_unlike(blocks: np.ndarray, period: Sequence[Shot], names: Sequence[str]) -> str | None:
    """Return which tracking frame is not as bright as those of the periods around it."""
    count, worst = len(period), (1.0, 0)
    for place in (place for place, shot in enumerate(period) if _is_tracking(shot)):
        light = blocks[place::count].mean(axis=1)
        for step, own in enumerate(light):
            first = max(0, step - NEAR)
            others = np.delete(light[first:step + NEAR + 1], step - first)
            gain = max(float(own), 1e-30) / max(float(np.median(others)), 1e-30) if len(others) else 1.0
            worst = max(worst, (gain, place + step * count), key=lambda each: abs(np.log(each[0])))
    gain, frame = worst
    if 1 / ALIKE <= gain <= ALIKE:
        return None
    return (f"{names[frame]}: should be a tracking frame, and has {gain:.2g} times the light of those of the periods around it: "
            "lamps failed, or a frame was lost")


def _is_tracking(shot: Shot) -> bool:
    return shot.name.endswith(TRACKING)


def _is_full(shot: Shot) -> bool:
    """Return whether all lamps shine, in a tracking frame or the last one of gradients."""
    return isinstance(shot.light, FullLight) or (isinstance(shot.light, GradientLight) and shot.light.axis == "full")
