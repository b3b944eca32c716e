"""What a scan says of the space before its surface: a set of points, or a range image."""

import numpy as np
import pytest

from service.scans.points.cloud import Thinned, cloud_of
from service.scans.registration.free_space import DepthRange, contradiction
from stage.capture.camera import Camera

SPACING = 0.01
AWAY = 1.0


def sheet(z, origin, sigma=1e-4):
    """Points of a bent sheet at about `z`, as a scanner at `origin` sees them; None: along parallel lines."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-0.3, 0.3, SPACING), np.arange(-0.3, 0.3, SPACING)))
    points = np.stack([x, y, z + 0.2 * x**2], axis=1)
    lines = np.tile([0.0, 0.0, -1.0], (len(points), 1)) if origin is None else points - origin
    thinned = Thinned(points, lines / np.linalg.norm(lines, axis=1, keepdims=True), np.full(len(points), sigma))
    return cloud_of(thinned, most=len(points))


@pytest.mark.parametrize(("origin", "part"), [(np.zeros(3), 1.0), (None, 0.0)])
@pytest.mark.parametrize("side", [0.0, 0.2])
def test_points_before_a_set_are_contradicted_where_its_lines_meet(origin, part, side):
    """Half way between a scanner and its surface nothing can be; lines that meet nowhere do not tell which points lie before a surface."""
    pose = np.eye(4)
    pose[0, 3] = side
    found = contradiction(None, None, sheet(-AWAY, origin), sheet(-AWAY / 2, np.zeros(3)), pose, tolerance=SPACING / 2)
    assert found.before_sets == pytest.approx(part, abs=0.01)  # of the two sheets, the far one lies before nothing


@pytest.mark.parametrize(("sigma", "part"), [(1e-4, 1.0), (0.03, 1.0), (0.06, 0.0)])
def test_points_before_a_range_image_are_contradicted_by_more_than_their_sigma(sigma, part):
    """They lie 0.2 m before a plane: 6.7 of the second σ, 3.3 of the third."""
    camera = Camera(projection="perspective", resolution=(64, 64), focal_px=(60.0, 60.0))
    image = DepthRange(camera, 1, *(np.full((64, 64), AWAY + 0.2, dtype=np.float32) for _ in range(2)))
    nothing = sheet(-10 * AWAY, np.zeros(3))
    found = contradiction(image, None, nothing, sheet(-AWAY, np.zeros(3), sigma), np.eye(4), tolerance=SPACING)
    assert found.points == part and found.surface == pytest.approx(part, abs=0.2)  # what is on the border of the sheet does not count
