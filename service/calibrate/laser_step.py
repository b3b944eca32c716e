"""Calibration of the planes of a laser from its stripes on a step of known height, a right-angled block on a flat base."""

from typing import Any, NamedTuple

import numpy as np

from kernels.status import Status
from kernels.structured.stripe import find_stripe
from service.calibrate.even_light import even_light
from service.calibrate.solvers.laser_step import StepFit, fit_step
from service.calibrate.solvers.step_stripe import StepStripe, split_stripe
from service.depth.laser.laser import ambient_light
from service.depth.laser.stripes import stripe_signal
from service.reporting.progress import Timings
from stage.capture.capture import Capture
from stage.capture.manifest import Frame
from stage.errors import CalibrationError
from stage.stack.correction import Correction

LEAST_EVEN = 0.02
"""Part of the brightest light of the room below which a pixel says nothing of its albedo."""
LARGEST_RESIDUAL_PX = 1.0
"""Largest root mean square distance of the lines of a stripe from where the planes put them."""


class StepPoses(NamedTuple):
    """The planes that stripes on a step give, and what was seen of it."""

    fit: StepFit
    poses: list[dict[str, Any]]
    """Facts of each capture for the report: folder, stripes that were used, those that show the riser, the base's distance."""


def planes_on_step(captures: list[Capture], frames: list[list[Frame]], height_m: float, device: str, timings: Timings) -> StepPoses:
    """Measure planes on a step.

    Args:
        captures: one for each pose of the step.
        frames: the laser frames of each, the same planes in each.
        height_m: height of the step, metres.

    Raises:
        StageError: a frame is unreadable.
        CalibrationError: the stripes do not show the step, or do not determine the planes.
    """
    camera = captures[0].camera
    assert camera.focal_px is not None
    pixel = 2 / sum(camera.focal_px)
    stripes = []
    timings.stage("steps", len(captures))
    for number, (capture, shown) in enumerate(zip(captures, frames, strict=True), start=1):
        stripes.append(_stripes(capture, shown, device, pixel))
        timings.advance(number)
    fit = fit_step(stripes, height_m, pixel)
    poses = [{"capture": str(capture.folder), "stripes": sum(stripe is not None for stripe in found),
              "with_riser": sum(stripe is not None and stripe.riser is not None for stripe in found),
              "distance_m": float(f"{distance:.5g}")}
             for capture, found, distance in zip(captures, stripes, fit.distances_m, strict=True)]
    return StepPoses(fit, poses)


def _stripes(capture: Capture, frames: list[Frame], device: str, pixel: float) -> list[StepStripe | None]:
    """Return the stripe of each frame of a capture, along rows or columns, whichever shows more of it."""
    correction, mask = Correction.of(capture), capture.mask()
    background, _ = ambient_light(capture, correction, frames, Timings(None))
    albedo = _albedo(capture, correction, mask)
    found: list[StepStripe | None] = []
    for frame in frames:
        signal = stripe_signal(correction.apply(frame).pixels - background, mask)
        best: StepStripe | None = None
        most = 0
        for along in ("row", "column"):
            stripe = find_stripe(np.ascontiguousarray(signal.values), along=along, noise=signal.noise, device=device, albedo=albedo)
            centre, status = stripe.centre.numpy(), stripe.status.numpy()
            lines = np.flatnonzero(status == Status.OK)
            across, down = centre[lines].astype(np.float64), lines + 0.5
            x, y = capture.camera.plane_at(*((across, down) if along == "row" else (down, across)))
            parts = split_stripe(x, y, lines, pixel)
            if parts is not None and len(lines) > most:
                best, most = parts, len(lines)
        found.append(best)
    return found


def _albedo(capture: Capture, correction: Correction, mask: np.ndarray) -> np.ndarray | None:
    """Return how bright the scene is under even light, by which stripes are divided; None: none shows it, or parts are too dark."""
    light = even_light(capture, correction)
    if light is None:
        return None
    grey = np.where(mask, light, 0)
    least = LEAST_EVEN * float(grey.max())
    return np.maximum(grey, 0) if least > 0 and (grey[mask] > least).all() else None


def check_step(fit: StepFit, names: list[str]) -> None:
    """Refuse planes whose lines miss the step by far more than their noise.

    Raises:
        CalibrationError: names the frame that fits worst.
    """
    worst = max(range(len(names)), key=lambda number: fit.planes[number].residual_px)
    if fit.planes[worst].residual_px > LARGEST_RESIDUAL_PX:
        raise CalibrationError(f"frame {names[worst]}: its stripe misses base, riser and top of an upright block by "
                               f"{fit.planes[worst].residual_px:.2g} px: look for light of other surfaces, a base that is not flat, or a "
                               "block that is not right-angled")
