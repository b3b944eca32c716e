"""A reference ball of the material of the object under the same lights, and the pixel at which it shows a normal.

Source: Woodham, "Photometric method for determining surface orientation from multiple images", Optical Engineering 19(1),
    1980; Hertzmann and Seitz, "Example-based photometric stereo", TPAMI 27(8), 2005.
"""

from typing import NamedTuple

import numpy as np

from service.light_estimation.ball import Ball, ball_from_mask
from stage.capture.capture import Capture
from stage.capture.light import PointLight
from stage.capture.lighting import check_surface
from stage.capture.manifest import FILE_NAME
from stage.errors import ManifestError

RIM_PX = 1.5
"""The distance from the outline inwards within which no pixel is read, because a pixel on the outline mixes in background."""
LEAST_RADIUS_PX = 8.0
"""The least radius of a ball: neighbouring pixels of a smaller ball differ by more than 7° in their normals."""
LEAST_LIGHTS = 3
"""The least number of lights that determine a normal."""


class ReferenceBall(NamedTuple):
    """A reference ball and its capture, after the check against the capture that is solved with it."""

    capture: Capture
    ball: Ball

    def pixel_of(self, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the position in the image at which the ball shows each normal, at least RIM_PX inside the outline.
        `normal`: [n, 3] unit, camera frame. Returns column and row, each [n] float64, in array elements: the centre of the first pixel
        is (0, 0)."""
        camera = self.capture.camera
        across = normal[:, :2] / np.maximum(np.linalg.norm(normal[:, :2], axis=1, keepdims=True), 1e-12)
        radius = np.minimum(np.linalg.norm(normal[:, :2], axis=1), 1 - RIM_PX / self.ball.radius_px)
        x, y = (self.ball.centre[:2] + self.ball.radius * across * radius[:, None]).T
        per_unit = 1 / (camera.pixel_size_m or 1.0)
        centre_u, centre_v = camera.principal_point
        return centre_u + x * per_unit - 0.5, centre_v - y * per_unit - 0.5


def reference_ball(capture: Capture, reference: Capture) -> ReferenceBall:
    """Check that the capture of a reference ball fits the capture that is solved, and find the ball in it.
    Raises ManifestError: an image has one pixel, the lights or their order differ, a light is a point light, a camera is perspective, or
    the reference has no mask. Raises CalibrationError: the mask shows no ball."""
    where = reference.folder / FILE_NAME
    check_surface(capture)
    ours, theirs = capture.sources(), reference.sources()
    if len(ours) != len(theirs):
        raise ManifestError(f"{where}: frames: {len(theirs)} are lit, the capture has {len(ours)}: "
                            "photograph the ball under the same lights")
    if len(ours) < LEAST_LIGHTS:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: {len(ours)} are lit: a normal needs three or more")
    for index, (mine, given) in enumerate(zip(ours, theirs, strict=True)):
        if mine.light != given.light:
            raise ManifestError(f"{where}: frames: the light of {given.image} is not that of {mine.image} of the capture (lit "
                                f"frame {index}): the same lights must follow in the same order")
        if isinstance(mine.light, PointLight):
            raise ManifestError(f"{where}: frames: the light of {given.image} is point: a near light does not fall "
                                "on ball and object alike")
    for one in (capture, reference):
        if one.camera.projection != "orthographic":
            raise ManifestError(f"{one.folder / FILE_NAME}: camera.projection: is perspective: a reference ball serves "
                                "an orthographic camera, which sees equal normals under equal angles")
    if reference.manifest.mask is None:
        raise ManifestError(f"{where}: mask: is missing: it says where the ball is")
    ball = ball_from_mask(reference.camera, reference.mask().astype(np.float64))
    if ball.radius_px < LEAST_RADIUS_PX:
        raise ManifestError(f"{where}: mask: the ball has a radius of {ball.radius_px:.1f} pixels: "
                            f"it needs {LEAST_RADIUS_PX:g} or more")
    return ReferenceBall(reference, ball)
