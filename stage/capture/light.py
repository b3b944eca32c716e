"""The types of light that a manifest declares for a frame, laser and time-of-flight sources among them."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stage.model import Count, Direction, FirstFault, LitRgb, Positive, Rgb, Strict, Text, Vector

Polarization = Literal["none", "parallel", "cross"]
"""How the polariser of the camera stands to that of the light."""


class DistantLight(Strict):
    """A distant light, which has the same direction and irradiance at every point."""

    type: Literal["distant"]
    """The type of the light."""
    direction: Direction
    """The unit vector from the surface to the light, in the camera frame."""
    irradiance: LitRgb
    """The irradiance at normal incidence in relative units, which are the same for all lights of a capture."""
    polarization: Polarization = "none"
    """How the polariser of the camera stands to that of the light; a light that has a `cross` frame has a `parallel` one too."""


PLACEHOLDER = DistantLight(type="distant", direction=(0.0, 0.0, 1.0), irradiance=(1.0, 1.0, 1.0))
"""The light that a manifest gives to frames whose light is yet to be measured, in place of each."""


class PointLight(Strict):
    """A point light at a finite distance d, whose irradiance at normal incidence is intensity · cos^μ / d².

    The cosine is that of the angle between `axis` and the direction from the light to the surface; μ is `anisotropy`.
    """

    type: Literal["point"]
    """The type of the light."""
    position_m: Vector
    """The place of the light in the camera frame: x to the right, y up, z towards the viewer. The camera must have a scale."""
    intensity: LitRgb
    """The irradiance that the light causes at normal incidence one metre away, on its axis, in the unit of the other lights."""
    axis: Direction | None = None
    """The direction in which the light shines most, from the light outwards; None: it shines alike in all directions."""
    anisotropy: Annotated[float, Field(ge=0)] | None = None
    """The exponent μ of the cosine of the angle from `axis`, 1 for a flat LED; it needs `axis`. None: 0, alike in all directions."""
    polarization: Polarization = "none"
    """How the polariser of the camera stands to that of the light; a light that has a `cross` frame has a `parallel` one too."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.anisotropy is not None and self.axis is None:
            raise ValueError("anisotropy needs axis")
        return self


class ExtendedLight(Strict):
    """An area source, given as samples of the sphere of directions (photometric sampling, Nayar, Ikeuchi and Kanade 1990)."""

    type: Literal["extended"]
    """The type of the light."""
    directions: Annotated[tuple[Direction, ...], Field(min_length=1), FirstFault]
    """The unit vector from the surface to each sample, in the camera frame."""
    radiance: Annotated[tuple[Rgb, ...], Field(min_length=1), FirstFault]
    """The radiance of each sample, all of one colour; radiance times solid angle has the unit of `irradiance`."""
    solid_angle: Annotated[tuple[Positive, ...], Field(min_length=1), FirstFault]
    """The solid angle of each sample in steradians."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        counts = len(self.directions), len(self.radiance), len(self.solid_angle)
        if len(set(counts)) > 1:
            raise ValueError("has {} directions, {} radiance and {} solid_angle entries: give one each".format(*counts))
        if not any(map(any, self.radiance)):
            raise ValueError("has no radiance above 0: a light gives light")
        return self


class GradientLight(Strict):
    """Spherical gradient illumination, whose radiance from direction ω is (1 ± ω_axis) / 2, or 1 for axis `full` (Ma et al. 2007)."""

    type: Literal["gradient"]
    """The type of the light."""
    axis: Literal["x", "y", "z", "full"]
    """The axis of the camera frame along which the radiance grows from 0 to 1, or `full` for 1 everywhere."""
    sign: Literal[1, -1] = 1
    """-1 where the radiance falls along the axis."""
    polarization: Polarization = "none"
    """How the polariser of the camera stands to those of the lights; `none` without polarisers."""


class EnvironmentLight(Strict):
    """An environment, given as a lat-long map; its frame is a photograph with which relit images are compared."""

    type: Literal["environment"]
    """The type of the light."""
    image: Text
    """The lat-long map, a file of the folder: .exr or .hdr, twice as wide as high."""


class OffLight(Strict):
    """Ambient light alone; its frames are subtracted from the other frames."""

    type: Literal["off"]
    """The type of the light."""


class FullLight(Strict):
    """All lights together, as in a tracking frame."""

    type: Literal["full"]
    """The type of the light."""


Light = Annotated[
    DistantLight | PointLight | ExtendedLight | GradientLight | EnvironmentLight | OffLight | FullLight,
    Field(discriminator="type"),
]
"""A light of any type; the key `type` tells which."""


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
    accuracy_deg: Positive | None = None
    """The standard deviation of the plane's angle as it was calibrated, which the deviations of its depths then hold, as
    `relit calibrate laser-planes` writes it. None: it is not known, and they hold that of the light alone."""
    accuracy_m: Positive | None = None
    """The standard deviation of the plane's place at point_m, along its normal, as it was calibrated: accuracy_deg is then that of a turn
    about point_m. None: accuracy_deg is that of a turn about the plane's point nearest to the camera."""

    @model_validator(mode="after")
    def _both_accuracies(self) -> Self:
        if self.accuracy_m is not None and self.accuracy_deg is None:
            raise ValueError("accuracy_m: needs accuracy_deg beside it")
        return self


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
