"""Curves of one frame that the curves of other frames contradict: they see other depths at the same places, in more light.

A stripe of a plane that nobody declared, or a reflection, gives a surface of its own, which lies before or behind the true one. Where the
declared plane passes over the same pixels in other frames, both cannot be; the fainter one is not the laser's.
"""

import numpy as np

from kernels.status import Status
from service.depth.stripe_curves import RIVAL, WHOLE
from service.depth.stripe_map import StripeSamples
from stage.camera import Camera
from stage.depth_breaks import same_surface

REACH_PX = 10.0
"""Distance on a line up to which stripes of two frames are compared."""


def contradicted(samples: StripeSamples, curve: np.ndarray, camera: Camera, *, doubled: bool) -> np.ndarray:
    """Return which samples belong to curves that the curves of other frames contradict, [n] bool.

    A sample is contradicted where the nearest stripe of another frame lies on another surface, and none on either side lies on its own; on
    the edge of a surface one side does. A curve is contradicted where a third of its samples are, by stripes of three times its brightness
    (their median: texture changes single ones). Where frames of the capture show two stripes, stripes of any brightness contradict it; else
    it may see a post that is narrower than the distance of the planes.

    Args:
        samples: of all frames whose stripes cross the same lines; those that are OK are compared.
        curve: [n] int, number of the curve of each sample, different for curves of different frames.
        camera: perspective.
        doubled: whether frames of the capture show two stripes.
    """
    ok = np.flatnonzero(samples.status == Status.OK)
    order = ok[np.lexsort((samples.place[ok], samples.line[ok]))]
    line, place, depth, bright, owner = (values[order] for values in (samples.line, samples.place, samples.depth, samples.amplitude, curve))
    against, beside = np.zeros((2, len(order)), bool), np.zeros((2, len(order)), bool)
    ratio = np.ones((2, len(order)))
    for side, step in enumerate((-1, 1)):
        at = np.arange(len(order))
        other = at + step
        inside = (other >= 0) & (other < len(order))
        other = np.where(inside, other, at)
        gap = np.abs(place[other] - place)
        near = inside & (line[other] == line) & (gap <= REACH_PX) & (owner[other] != owner)
        apart = ~same_surface(depth, depth[other], np.maximum(gap, 1.0), camera)
        against[side], beside[side] = near & apart, near & ~apart
        ratio[side] = np.where(near & apart, bright / np.maximum(bright[other], 1e-30), np.inf)
    alone = against.any(axis=0) & ~beside.any(axis=0)
    found = np.zeros(len(samples.status), bool)
    for number in np.unique(owner[alone]):
        mine = owner == number
        doubted = mine & alone
        if doubted.sum() >= WHOLE * mine.sum() and (doubled or np.median(ratio.min(axis=0)[doubted]) < RIVAL):
            found[order[mine]] = True
    return found
