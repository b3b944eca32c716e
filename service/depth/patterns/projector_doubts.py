"""Whether decoded columns and rows contradict the calibration of the projector: said, held by σ, or taken as the projector's own."""

import numpy as np

from kernels.status import SOLVED
from service.depth.base.epipolar import Contradiction, contradiction, difference, view_facts
from service.depth.base.solution import DepthSolution
from service.depth.patterns.coordinates import AxisMaps
from stage.capture.camera import Camera
from stage.capture.projector import Projector

ALIKE = 9.0
"""Number of neighbours whose errors are counted as one, as those of one stripe are."""
LEAST_PX = 0.1
"""Least systematic distance from the epipolar lines that is one, which good calibrations and uneven stripes do not reach."""


def contradicted(solution: DepthSolution, u: AxisMaps, v: AxisMaps, camera: Camera, projector: Projector,
                 before: Contradiction | None) -> Contradiction | None:
    """Return how columns and rows contradict a projector; None where they do not.
    `before`: the contradiction by which the projector was found."""
    judged = _judged(solution, u, v)
    return contradiction(projector, camera.points(-solution.depth)[judged], np.stack([u.coordinate[judged], v.coordinate[judged]], axis=1),
                         np.stack([u.sigma[judged], v.sigma[judged]], axis=1), least_px=LEAST_PX, alike=ALIKE, before=before)


def widen(solution: DepthSolution, u: AxisMaps, v: AxisMaps, camera: Camera, found: Contradiction, declared: Projector) -> None:
    """Add to σ by how much depths may be off where columns and rows contradict the calibration, and say so.
    `declared`: the projector as it was given; depths may be those of one that was found."""
    judged = _judged(solution, u, v)
    off = found.error(camera.points(-solution.depth)[judged], np.stack([u.sigma[judged], v.sigma[judged]], axis=1),
                      given=declared)
    assert solution.sigma is not None
    more = np.where(np.isin(solution.status, SOLVED), float(np.median(off)), 0.0)
    more[judged] = off
    solution.sigma[:] = np.hypot(solution.sigma, more)
    solution.facts["contradiction_px"] = float(f"{found.size_px:.3g}")
    if found.declared is not declared:
        view = found.declared
        solution.facts["refined_projector"] = view_facts(view, "camera_from_projector", view.camera_from_projector)
        solution.warnings.append(
            f"projector: columns and rows contradict its calibration, {difference(declared, found.declared)}: depths are those of a "
            f"projector that is ({found.noise_px:.2g} px are left), which found.refined_projector in report.json holds, and the standard "
            "deviations hold what this leaves open")
    elif not found.plausible:
        solution.warnings.append(
            f"projector: columns and rows contradict its calibration by {found.size_px:.2g} px ({found.noise_px:.2g} px are left by "
            "noise), which no small turn of it and no other focal length explain: its lens, or that of the camera, is not known all over "
            "the image, or something moved while it was calibrated: calibrate again (relit calibrate procam), with boards up to the edges")
    else:
        solution.warnings.append(
            f"projector: columns and rows contradict its calibration by {found.size_px:.2g} px ({found.noise_px:.2g} px are left by "
            f"noise), {difference(declared, found.projector)}: measure it again with relit calibrate procam, or take it as found "
            "(--refine-projector); the standard deviations hold the error that this makes")


def _judged(solution: DepthSolution, u: AxisMaps, v: AxisMaps) -> np.ndarray:
    return np.isin(solution.status, SOLVED) & u.solved & v.solved
