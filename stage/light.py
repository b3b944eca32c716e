"""Lights as the manifest declares them: what lit one frame."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stage.model import Direction, FirstFault, LitRgb, Positive, Rgb, Strict, Text, Vector


class DistantLight(Strict):
    """One far light: the same direction and irradiance at every point."""

    type: Literal["distant"]
    direction: Direction
    """Unit vector from the surface to the light, camera frame."""
    irradiance: LitRgb
    """At normal incidence, relative; one scale across a capture."""


class PointLight(Strict):
    """One near light: irradiance = intensity·cos^μ/d², the cosine between `axis` and the way to the surface."""

    type: Literal["point"]
    position_m: Vector
    intensity: LitRgb
    axis: Direction | None = None
    anisotropy: Annotated[float, Field(ge=0)] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.anisotropy is not None and self.axis is None:
            raise ValueError("anisotropy needs axis")
        return self


class ExtendedLight(Strict):
    """An area source as samples of the sphere (photometric sampling, Nayar, Ikeuchi and Kanade 1990)."""

    type: Literal["extended"]
    directions: Annotated[tuple[Direction, ...], Field(min_length=1), FirstFault]
    radiance: Annotated[tuple[Rgb, ...], Field(min_length=1), FirstFault]
    solid_angle: Annotated[tuple[Positive, ...], Field(min_length=1), FirstFault]
    """Steradians of each sample."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        counts = len(self.directions), len(self.radiance), len(self.solid_angle)
        if len(set(counts)) > 1:
            raise ValueError("has {} directions, {} radiance and {} solid_angle entries: give one each".format(*counts))
        if not any(map(any, self.radiance)):
            raise ValueError("has no radiance above 0: a light gives light")
        return self


class GradientLight(Strict):
    """Spherical gradient illumination (1 ± axis)/2 (Ma et al. 2007)."""

    type: Literal["gradient"]
    axis: Literal["x", "y", "z", "full"]
    sign: Literal[1, -1] = 1
    polarization: Literal["none", "parallel", "cross"] = "none"


class EnvironmentLight(Strict):
    """Lit by a lat-long map: a real reference for relighting."""

    type: Literal["environment"]
    image: Text


class OffLight(Strict):
    """Ambient light only; subtracted from the other frames."""

    type: Literal["off"]


class FullLight(Strict):
    """Every light on: a tracking frame."""

    type: Literal["full"]


Light = Annotated[
    DistantLight | PointLight | ExtendedLight | GradientLight | EnvironmentLight | OffLight | FullLight,
    Field(discriminator="type"),
]
"""Any of the light types, told apart by `type`."""
