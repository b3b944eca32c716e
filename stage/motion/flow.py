"""Dense optical flow between two tracking frames, and where it can be trusted."""

from typing import Any, NamedTuple

import cv2
import numpy as np

from stage.colour import GREY_WEIGHTS
from stage.motion.resample import bicubic, lookup, positions

DISAGREEMENT_PX = 0.5
"""Forward and backward flow that miss each other by more are not the same point: half a pixel is a visible smear, and seven times
the median error on textured objects that turn by 5° (tests/stage/motion)."""
WHITE_PERCENTILE = 99.0
"""The brightest percent of the subject are highlights, which do not move with it; white lies a little above what they leave."""
HEADROOM = 1.25
DISPLAY_GAMMA = 2.2
"""Flow is found on display-like values: equal steps are then equally visible, so eight bits hold shade as well as light."""
REFINEMENTS = 10
"""Fixed-point iterations of the float refinement; 30 gain less than a hundredth of a pixel."""
SMOOTH_PX, FAINT = 4.0, 1e-3
"""A guess goes on beyond the pixels it is known from by a Gaussian of half of the search's patch, and far from them as their
median, which counts for a thousandth."""


class Flow(NamedTuple):
    """Where the points of the reference frame lie in another frame."""

    displacement: np.ndarray  # [rows, cols, 2] float32, pixels right and down
    known: np.ndarray  # [rows, cols] bool; False where it leads out of the image or the backward flow does not lead back


def white_level(radiance: np.ndarray, mask: np.ndarray) -> float:
    """How bright the subject is, highlights aside.

    Args:
        radiance: [rows, cols, 3] float32, linear.
        mask: [rows, cols] bool.
    """
    return float(np.percentile(radiance[mask] @ np.asarray(GREY_WEIGHTS, dtype=np.float32), WHITE_PERCENTILE))


def display(radiance: np.ndarray, white: float) -> np.ndarray:
    """A linear image as flow is found on it: grey, `white` a little below the top, gamma-encoded.

    Returns:
        [rows, cols] float32, 0 to 255.
    """
    grey = radiance @ np.asarray(GREY_WEIGHTS, dtype=np.float32)
    return 255 * np.clip(grey / np.float32(HEADROOM * white), 0, 1) ** np.float32(1 / DISPLAY_GAMMA)


def match(reference: np.ndarray, other: np.ndarray, guess: np.ndarray | None = None) -> Flow:
    """Follow every point of one frame into another.

    The search shifts patches and does not turn them: with a guess the other frame is first warped by it, and what is searched is
    the rest. So a subject may turn by any angle in small steps, and errors do not add up over them.

    Args:
        reference: [rows, cols] float32, from `display`.
        other: the same of the other frame.
        guess: [rows, cols, 2] float32, a displacement near the one sought, from `carry_on`.

    Source:
        Kroeger et al. 2016, Fast optical flow using dense inverse search (OpenCV's, at full resolution), then OpenCV's
        variational refinement (Brox et al. 2004) on the float images, which are finer than the eight bits of the search.
        Forward-backward agreement as in Sundaram et al. 2010, with a fixed bound.
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


def carry_on(flow: Flow, mask: np.ndarray) -> np.ndarray:
    """The flow to one tracking frame as a guess for the next: where it is known on the subject, and smoothly on around that.

    Args:
        flow: to the frame nearer in time.
        mask: [rows, cols] bool, where the subject is.

    Returns:
        [rows, cols, 2] float32.
    """
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
