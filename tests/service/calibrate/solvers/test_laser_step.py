"""Laser planes from exact lines on a step: right where some stripes rise on another face of the block."""

import numpy as np
import pytest

from service.calibrate.solvers.laser_step import fit_step
from service.calibrate.solvers.step_stripe import Segment, StepStripe
from tests.scenes.step import HEIGHT, LASER, Step, laser_planes

PIXEL = 1 / 480


def segment(*ends):
    """The line through two points in the camera frame, as of 40 points that scatter by a twentieth of a pixel."""
    (ax, ay), (bx, by) = seen = np.array([end[:2] / -end[2] for end in ends])
    line = np.array([ay - by, bx - ax, ax * by - bx * ay])
    return Segment(seen, 20.0, 0.05 * PIXEL, line / np.hypot(*line[:2]))


def stripe(step, normal, riser):
    """Lines of a laser plane on base, top, and the upright face with the normal `riser`."""
    def corner(height, away):
        planes = np.array([normal, step.normal, riser])
        return np.linalg.solve(planes, [normal @ LASER, step.normal @ step.place + height, riser @ step.place + away])

    front = step.width / 2
    return StepStripe(segment(corner(0, front + 0.02), corner(0, front + 0.05)), segment(corner(HEIGHT, front - 0.02), corner(HEIGHT, 0)),
                      segment(corner(0.2 * HEIGHT, front), corner(0.8 * HEIGHT, front)), 1)


@pytest.mark.parametrize("aside", [0, 2])
def test_stripes_that_rise_on_another_face_do_not_count_as_its_edge(aside):
    """Two of seven stripes cross the corner of the block; for them the solver refused it as leaning. Lines are exact, and planes as good
    as the solver's last step."""
    step, planes = Step(), laser_planes(7)
    other = step.facing + 0.9 * np.cross(step.normal, step.facing)
    other /= np.linalg.norm(other)
    whole = [stripe(step, normal, step.facing) for normal in planes]
    turned = [own._replace(riser=stripe(step, normal, other).riser) if number >= 7 - aside else own
              for number, (own, normal) in enumerate(zip(whole, planes, strict=True))]
    found = fit_step([turned], HEIGHT, PIXEL)
    assert found.distances_m == pytest.approx([abs(step.normal @ step.place)], rel=1e-4)
    for plane, normal in zip(found.planes, planes, strict=True):
        assert np.degrees(np.arccos(min(1.0, abs(plane.normal @ normal)))) < 0.01
