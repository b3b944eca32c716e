"""The length that a unit of a solved surface stands for."""

from stage.camera import Camera

UNIT_WITHOUT_SCALE_M = 0.001
"""Metres of a pixel where the capture has no scale, so that the asset has a visible size."""

SCALE_NOTE = "unknown: the capture gives no scale, so one pixel is taken as one millimetre"


def unit_in_metres(camera: Camera) -> float:
    """Return the metres of a unit of the height map: 1, or that of a pixel where the capture has no scale."""
    return 1.0 if camera.metric else UNIT_WITHOUT_SCALE_M
