"""Dense optical flow between two tracking frames, and the pixels at which it is reliable."""

from typing import Any, NamedTuple

import cv2
import numpy as np

from stage.colour.colour import GREY_WEIGHTS
from stage.motion.resample import bicubic, lookup, positions

DISAGREEMENT_PX = 0.5
"""The largest distance between a point and its image under forward and backward flow: half a pixel is a visible blur, and seven times
the median error on textured objects that turn by 5° (tests/stage/motion)."""
WHITE_PERCENTILE = 99.0
"""The percentile that stands for white: the brightest percent of the subject are highlights, which do not move with it."""
HEADROOM = 1.25
"""The radiance that is shown as 255, relative to the white level."""
DISPLAY_GAMMA = 2.2
"""The exponent of the display-encoded images on which flow is found: their eight bits resolve dark and bright parts equally."""
REFINEMENTS = 10
"""The fixed-point iterations of the variational refinement; 30 iterations gain less than a hundredth of a pixel."""
SMOOTH_PX, FAINT = 4.0, 1e-3
"""The standard deviation of the Gaussian that extrapolates a flow, half the patch of the search, and the weight of the median flow,
which remains far from all known pixels."""


class Flow(NamedTuple):
    """The displacement of every pixel of the reference frame to another frame."""

    displacement: np.ndarray  # [rows, cols, 2] float32, pixels right and down
    known: np.ndarray  # [rows, cols] bool; False where it leads out of the image, or the backward flow does not return


def white_level(radiance: np.ndarray, mask: np.ndarray) -> float:
    """Return the brightness of the subject without its highlights, the WHITE_PERCENTILE of its grey values.
    `radiance`: [rows, cols, 3] float32, linear. `mask`: [rows, cols] bool, True on the subject."""
    return float(np.percentile(radiance[mask] @ np.asarray(GREY_WEIGHTS, dtype=np.float32), WHITE_PERCENTILE))


def display(radiance: np.ndarray, white: float) -> np.ndarray:
    """Return the image on which flow is found: grey, gamma-encoded, with `white` somewhat below 255.
    Returns [rows, cols] float32, 0 to 255."""
    grey = radiance @ np.asarray(GREY_WEIGHTS, dtype=np.float32)
    return 255 * np.clip(grey / np.float32(HEADROOM * white), 0, 1) ** np.float32(1 / DISPLAY_GAMMA)


def find_flow(
    reference: np.ndarray,  # [rows, cols] float32, from `display`
    other: np.ndarray,  # the same for the other frame
    guess: np.ndarray | None = None,  # [rows, cols, 2] float32, an approximate displacement from `extrapolate`, or None
) -> Flow:
    """Find the optical flow from the reference frame to another frame.

    The search shifts patches and does not rotate them. With a guess the other frame is warped by it first, and the remaining
    displacement is searched. A subject may therefore turn by any angle in small steps, and errors do not accumulate.

    Source:
        Kroeger et al., "Fast optical flow using dense inverse search", ECCV 2016 (OpenCV's, at full resolution), then the variational
        refinement of Brox et al., "High accuracy optical flow estimation based on a theory for warping", ECCV 2004 (OpenCV's), on
        the float images, which are finer than the eight bits of the search. Forward-backward check: Sundaram et al., "Dense point
        trajectories by GPU-accelerated large displacement optical flow", ECCV 2010, here with a fixed bound.
    """
    if guess is not None:
        other = bicubic(other, *positions(guess)[:2])
    rest, back = _search(reference, other), _search(other, reference)
    x, y, inside = positions(rest)
    miss = rest + lookup(back, x, y)
    known = inside & (np.hypot(miss[..., 0], miss[..., 1]) <= DISAGREEMENT_PX)
    if guess is None:
        return Flow(rest, known)
    whole = rest + lookup(guess, x, y)
    return Flow(whole, known & positions(whole)[2])


def extrapolate(flow: Flow, mask: np.ndarray) -> np.ndarray:
    """Extrapolate the flow to one tracking frame from its known pixels to the whole image, as a guess for the next tracking frame.
    `flow`: the flow to the tracking frame before the next one. `mask`: [rows, cols] bool, True on the subject. Returns [rows, cols, 2]
    float32."""
    trusted = flow.known & mask
    if not trusted.any():
        return flow.displacement
    weight = _smooth(trusted.astype(np.float32))[..., None]
    usual = np.median(flow.displacement[trusted], axis=0)
    total = _smooth(flow.displacement * trusted[..., None])
    return np.asarray((total + FAINT * usual) / (weight + FAINT), dtype=np.float32)


def _smooth(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), SMOOTH_PX))


def _search(reference: np.ndarray, other: np.ndarray) -> np.ndarray:
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)  # the preset stops at half the resolution, with five times the error
    coarse, target = (np.rint(image).clip(0, 255).astype(np.uint8) for image in (reference, other))
    none: Any = None
    found = search.calc(coarse, target, none)
    refinement = cv2.VariationalRefinement.create()
    refinement.setFixedPointIterations(REFINEMENTS)
    return np.asarray(refinement.calc(reference, other, found))
