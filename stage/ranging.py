"""Laser and time-of-flight frames as the manifest declares them."""

import math
from typing import Annotated, Literal

from pydantic import Field

from stage.model import Count, Direction, Positive, Strict, Vector


class LaserRay(Strict):
    """One laser spot: point-based range finding."""

    type: Literal["ray"]
    origin_m: Vector
    direction: Direction


class LaserPlane(Strict):
    """One laser stripe: light striping."""

    type: Literal["plane"]
    point_m: Vector
    normal: Direction


Laser = Annotated[LaserRay | LaserPlane, Field(discriminator="type")]
"""Either laser, told apart by `type`."""


class ContinuousWave(Strict):
    """One correlation image: I(δ) = P + Q·cos(φ - δ) at modulation f."""

    type: Literal["cw"]
    modulation_hz: Positive
    reference_phase_rad: Annotated[float, Field(ge=-4 * math.pi, le=4 * math.pi)]


class Pulsed(Strict):
    """Photon histograms, a (rows, cols, bins) array."""

    type: Literal["pulsed"]
    bin_s: Positive
    start_s: float
    pulses: Count | None = None
    first_photon_only: bool = False


TimeOfFlight = Annotated[ContinuousWave | Pulsed, Field(discriminator="type")]
"""Either kind of time of flight, told apart by `type`."""
