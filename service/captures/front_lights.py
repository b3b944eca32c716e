"""Limits of captures whose lights all stand in front of the object: no highlights on slopes, no light from the sides or from behind.

A surface shows the highlight of a light when its normal lies half way between the light and the view. Lights within an angle of the
view axis show highlights on normals within half of it.
"""

from typing import NamedTuple

import numpy as np

READINGS = 3
"""The least count of lights that a normal must face to be measured."""
NORMALS = 2000
"""The directions on the visible hemisphere at which lights are counted: shares are then good to a tenth of a per cent."""


class FrontLights(NamedTuple):
    """The directions that lights in front of the object reach."""

    widest_deg: float
    """The largest angle of a light from the view axis."""
    highlight_deg: float
    """The largest angle from the view axis of a normal that shows the highlight of a light."""
    elsewhere: float
    """The share of all directions, of those around the object, that are farther from the view axis than every light."""
    dark: float
    """The share of the normals that a camera can see which face fewer than three lights."""

    def sentence(self) -> str:
        """Return what the capture cannot show, for a person who looks at it."""
        text = (f"all lights are within {self.widest_deg:.0f} degrees of the view axis: surfaces turned more than {self.highlight_deg:.0f} "
                "degrees from the camera show no highlight, so that roughness and specular say little there; in relit frames the nearest "
                f"lights stand in for light from elsewhere, {100 * self.elsewhere:.0f} % of all directions")
        if self.dark >= 0.005:
            text += f"; {100 * self.dark:.0f} % of the directions that a visible surface may have face fewer than {READINGS} lights"
        return text


def front_lights(directions: np.ndarray) -> FrontLights | None:
    """Return what lights reach that all stand in front of the object, or None where one stands beside or behind it.

    Args:
        directions: [lights, 3] unit, from the object to each light, camera frame.
    """
    lowest = float(directions[:, 2].min()) if len(directions) else 0.0
    if lowest <= 0:
        return None
    widest = float(np.degrees(np.arccos(min(lowest, 1.0))))
    facing = (_hemisphere(NORMALS) @ directions.T > 0).sum(axis=1)
    return FrontLights(widest, widest / 2, (1 + lowest) / 2, float((facing < READINGS).mean()))


def _hemisphere(count: int) -> np.ndarray:
    """Return evenly spread unit directions with z above 0, [count, 3], on a spiral of the golden angle."""
    number = np.arange(count) + 0.5
    z, angle = number / count, np.pi * (1 + np.sqrt(5)) * number
    return np.column_stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])
