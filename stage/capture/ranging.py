"""The laser and time-of-flight sources that a manifest declares for a frame."""

import math
from typing import Annotated, Literal

from pydantic import Field

from stage.model import Count, Direction, Positive, Strict, Vector


class LaserRay(Strict):
    """A laser ray, which lights one spot."""

    type: Literal["ray"]
    """The type of the laser."""
    origin_m: Vector
    """A point of the ray in the camera frame, such as the laser's place."""
    direction: Direction
    """The direction of the ray in the camera frame."""


class LaserPlane(Strict):
    """A laser plane, which lights one stripe (light striping)."""

    type: Literal["plane"]
    """The type of the laser."""
    point_m: Vector
    """Any point of the plane in the camera frame."""
    normal: Direction
    """The normal of the plane in the camera frame, of either sign."""


Laser = Annotated[LaserRay | LaserPlane, Field(discriminator="type")]
"""A laser ray or plane; the key `type` tells which."""


class Emitter(Strict):
    """The position of the light source, which every kind of time-of-flight frame has."""

    source_m: Vector | None = None
    """The place of the light source in the camera frame; None: at the camera. Light then goes |p - source| + |p| to a point p and
    back."""


class ContinuousWave(Emitter):
    """The source of one correlation image of a continuous-wave camera: I(δ) = P + Q·cos(φ - δ) at modulation frequency f."""

    type: Literal["cw"]
    """The type of the source."""
    modulation_hz: Positive
    """The frequency f at which the light is modulated."""
    reference_phase_rad: Annotated[float, Field(ge=-4 * math.pi, le=4 * math.pi)]
    """The phase δ of the reference that the image is correlated with; three or more different ones are needed at a frequency."""


class Pulsed(Emitter):
    """The source of photon histograms, an array of (rows, cols, bins)."""

    type: Literal["pulsed"]
    """The type of the source."""
    bin_s: Positive
    """The width of a bin of the histograms."""
    start_s: float
    """The time of flight at which the first bin begins, there and back; it may be negative."""
    pulses: Count | None = None
    """The number of laser pulses behind each histogram, for pile-up; None: unknown, which `first_photon_only` does not allow."""
    first_photon_only: bool = False
    """True if the detector counts at most one photon a pulse, so that pile-up is corrected."""
    count_scale: Positive | None = None
    """Recorded units of one photon, where counts were multiplied, averaged or divided; None: estimated from the counts."""


TimeOfFlight = Annotated[ContinuousWave | Pulsed, Field(discriminator="type")]
"""A continuous-wave or pulsed source; the key `type` tells which."""
