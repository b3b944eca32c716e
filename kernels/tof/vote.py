"""A vote of the neighbours on the wraps that a pixel leaves undecided."""


import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.tof.unwrap import HYPOTHESES, Hypotheses

VOTE_RADIUS = 2
"""Half-width of the voting window, pixels: it holds 24 neighbours."""
VOTE_ROUNDS = 2
"""Number of votes: in the second, neighbours vote with the probabilities that the first gave them."""
SAME_SURFACE = 0.3
"""Largest difference of two ranges on the same surface, as a part of the wrap distance."""
CERTAIN = 1 - 1e-5
"""Probability of the best hypothesis from which a pixel keeps it without a vote: two rounds multiply the odds of another wrap by at most 1
/ UNSEEN_SURFACE²."""
UNSEEN_SURFACE = 0.02
"""Prior weight of a surface that none of the pixel's neighbours is on: it limits how far they can outvote the pixel's own measurement."""

wp.set_module_options({"enable_backward": False})


def vote(weighed: Hypotheses, rows: int, cols: int) -> Hypotheses:
    """Let neighbours decide between the hypotheses of each pixel; ranges stay what they are, probabilities move.

    The probability of a hypothesis is multiplied by the density that the neighbours' hypotheses, weighed by their probabilities, have at
    its range, plus a little for a pixel that is on none of their surfaces. Nothing is smoothed.

    Args:
        weighed: of `unwrap`; rows · cols pixels and padding.
        rows, cols: of the image.

    Raises:
        ArrayError: the image has another number of pixels.

    Source:
        Järemo Lawin, Forssén, Ovrén, "Efficient multi-frequency phase unwrapping using kernel density estimation", ECCV 2016; here
        as a factor on the pixel's own measurement.
    """
    device, pixels = weighed.range.device, weighed.range.shape[1]
    if not 0 < rows * cols <= pixels:
        raise ArrayError(f"there are {pixels} pixels, the image is {rows} x {cols}: give the image's own size")
    before = weighed.probability
    for _ in range(VOTE_ROUNDS):
        after = wp.zeros_like(before)
        devices.launch(_vote_kernel, rows * cols, [weighed.range, before, rows, cols, 1.0 / (SAME_SURFACE * weighed.spacing_m)], [after],
                       device=str(device))
        before = after
    return weighed._replace(probability=before)


@wp.func
def nearness(distance: float, inverse: float):
    """Return how near two ranges are: 1 where they are equal, 0 from a radius on (biweight)."""
    u = distance * inverse
    v = wp.max(1.0 - u * u, 0.0)
    return v * v


@wp.kernel(module="unique")
def _vote_kernel(first: int,
                 ranges: wp.array2d(dtype=wp.float32),  # [3, pixel]
                 before: wp.array2d(dtype=wp.float32),  # [3, pixel]
                 rows: int,
                 cols: int,
                 inverse: float,  # 1/m: of the radius within which ranges are one surface
                 # outputs
                 after: wp.array2d(dtype=wp.float32)):  # [3, pixel]
    p = first + wp.tid()
    if before[0, p] >= CERTAIN:
        for n in range(HYPOTHESES):
            after[n, p] = before[n, p]
    elif before[0, p] + before[1, p] + before[2, p] > 0.0:
        r = p // cols
        c = p - r * cols
        support = wp.vec3()
        voters = float(0.0)
        for i in range(wp.max(r - VOTE_RADIUS, 0), wp.min(r + VOTE_RADIUS + 1, rows)):
            for j in range(wp.max(c - VOTE_RADIUS, 0), wp.min(c + VOTE_RADIUS + 1, cols)):
                q = i * cols + j
                if q != p:
                    for k in range(HYPOTHESES):
                        w = before[k, q]
                        if w > 1.0e-3:
                            voters += w
                            for n in range(HYPOTHESES):
                                support[n] += w * nearness(ranges[k, q] - ranges[n, p], inverse)
        prior = UNSEEN_SURFACE * wp.max(voters, 1.0)
        odds = wp.vec3()
        for n in range(HYPOTHESES):
            odds[n] = before[n, p] * (prior + support[n])
        share = 1.0 / (odds[0] + odds[1] + odds[2])
        for n in range(HYPOTHESES):
            after[n, p] = odds[n] * share
