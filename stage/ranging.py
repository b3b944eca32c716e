"""The laser and time-of-flight sources that a manifest declares for a frame."""

import math
from typing import Annotated, Literal

from pydantic import Field

from stage.model import Count, Direction, Positive, Strict, Vector


class LaserRay(Strict):
    """A laser ray, which lights one spot."""

    type: Literal["ray"]
    origin_m: Vector
    direction: Direction


class LaserPlane(Strict):
    """A laser plane, which lights one stripe (light striping)."""

    type: Literal["plane"]
    point_m: Vector
    normal: Direction


Laser = Annotated[LaserRay | LaserPlane, Field(discriminator="type")]
"""A laser ray or plane; the key `type` tells which."""


class Emitter(Strict):
    """What every kind of time-of-flight frame says of the light: where it comes from."""

    source_m: Vector | None = None
    """The place of the light source in the camera frame, metres; None: at the camera. Light then goes |p - source| + |p| to a point p and
    back."""


class ContinuousWave(Emitter):
    """The source of one correlation image of a continuous-wave camera: I(δ) = P + Q·cos(φ - δ) at modulation frequency f."""

    type: Literal["cw"]
    modulation_hz: Positive
    reference_phase_rad: Annotated[float, Field(ge=-4 * math.pi, le=4 * math.pi)]


class Pulsed(Emitter):
    """The source of photon histograms, an array of (rows, cols, bins)."""

    type: Literal["pulsed"]
    bin_s: Positive
    start_s: float
    pulses: Count | None = None
    first_photon_only: bool = False
    count_scale: Positive | None = None
    """Recorded units of one photon, where counts were multiplied, averaged or divided; None: estimated from the counts."""


TimeOfFlight = Annotated[ContinuousWave | Pulsed, Field(discriminator="type")]
"""A continuous-wave or pulsed source; the key `type` tells which."""
