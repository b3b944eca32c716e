"""The options of `relit shade`."""

from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from service.requests.base.base import PixelOptions, Request, Role, Spelling
from service.requests.base.review import ReviewOptions
from service.requests.light.picture_options import PictureOptions
from stage.model import Finite, FirstFault

Vector = tuple[float, float, float]
RIGHT_ANGLE = 1e-3
"""The largest absolute cosine between the edges of a rectangle."""

BRIGHTEST = 1e15
"""The largest value of a light: far brighter than half can show, and safe from overflow."""


def _light(value: Vector) -> Vector:
    if min(value) < 0 or max(value) > BRIGHTEST:
        raise ValueError(f"light is 0 or more in every channel, and {BRIGHTEST:g} at the most")
    return value


Light = Annotated[Vector, AfterValidator(_light)]


class _NearLight(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class PointLight(_NearLight):
    """A point light: irradiance = intensity · cos^anisotropy / distance²."""

    position_m: Vector
    """Position in the camera frame, in metres; in pixels where the maps have no scale."""
    intensity: Light
    axis: Vector | None = None
    """Direction in which it shines; None: evenly in all."""
    anisotropy: float = Field(default=0.0, ge=0)
    """Exponent of the cosine about the axis."""

    @model_validator(mode="after")
    def _aimed(self) -> Self:
        if (self.axis is None) != (self.anisotropy == 0):
            raise ValueError("a lobe has an axis and an anisotropy above 0: give both or neither")
        if self.axis is not None and not any(self.axis):
            raise ValueError("the axis has no direction")
        return self


class SphereLight(_NearLight):
    """A sphere of even radiance."""

    center_m: Vector
    radius_m: float = Field(gt=0)
    radiance: Light


class RectangleLight(_NearLight):
    """A rectangle of even radiance that shines to one side, against edge_u × edge_v, as a UsdLux RectLight does."""

    center_m: Vector
    edge_u_m: Vector
    """Vector from one end of the edge to the other."""
    edge_v_m: Vector
    radiance: Light

    @model_validator(mode="after")
    def _right_angle(self) -> Self:
        u, v = (sum(x * x for x in edge) for edge in (self.edge_u_m, self.edge_v_m))
        across = sum(a * b for a, b in zip(self.edge_u_m, self.edge_v_m, strict=True))
        if not u * v > 0 or abs(across) > RIGHT_ANGLE * (u * v) ** 0.5:
            raise ValueError("edges of a rectangle have a length and stand at a right angle")
        return self


def _read(form: str, model: type[_NearLight]) -> Any:
    """Return a validator that reads `a,b,c,…`, the fields of a light one after another, also without those that have a default; lists of
    JSON become tuples."""
    counts = {name: 1 if field.annotation is float else 3 for name, field in model.model_fields.items()}
    whole, least = sum(counts.values()), sum(count for name, count in counts.items() if model.model_fields[name].is_required())

    def read(given: Any) -> Any:
        if isinstance(given, dict):
            return {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
        if not isinstance(given, str):
            return given
        try:
            numbers = [float(word) for word in given.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in (least, whole):
            raise ValueError(f"{given!r} is not {form}")
        found: dict[str, Any] = {}
        for name, count in counts.items():
            taken, numbers = numbers[:count], numbers[count:]
            if taken:
                found[name] = taken[0] if count == 1 else tuple(taken)
        return found

    return read


POINT_FORM = "x,y,z,r,g,b[,ax,ay,az,anisotropy]"
SPHERE_FORM = "x,y,z,radius,r,g,b"
RECTANGLE_FORM = "x,y,z,ux,uy,uz,vx,vy,vz,r,g,b"

GivenPoint = Annotated[PointLight, BeforeValidator(_read(POINT_FORM, PointLight))]
GivenSphere = Annotated[SphereLight, BeforeValidator(_read(SPHERE_FORM, SphereLight))]
GivenRectangle = Annotated[RectangleLight, BeforeValidator(_read(RECTANGLE_FORM, RectangleLight))]


class ShadeOptions(PictureOptions, PixelOptions):
    """Lights near the surface, and how its environment is turned."""

    light: Annotated[tuple[GivenPoint, ...], FirstFault, Spelling(metavar=POINT_FORM)] = ()
    """A point light: position in the camera frame in metres, and intensity; for a light that shines in a lobe also its axis and exponent.
    May be repeated."""
    sphere: Annotated[tuple[GivenSphere, ...], FirstFault, Spelling(metavar=SPHERE_FORM)] = ()
    """A sphere light: centre, radius, radiance. May be repeated."""
    rectangle: Annotated[tuple[GivenRectangle, ...], FirstFault, Spelling(metavar=RECTANGLE_FORM)] = ()
    """A rectangle light: centre, its two edges, radiance; it shines towards -(u x v), as a UsdLux RectLight does. May be repeated."""
    turn_degrees: Finite = 0.0
    """Degrees by which the environment is turned, about +y from +z towards +x."""


class ShadeRequest(ReviewOptions, ShadeOptions, Request):
    """A picture of solved maps under near lights, area lights and an environment, with cast shadows."""

    maps: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="DIR")]
    """Folder with maps.exr, or the file."""
    out: Annotated[Path, Role.FILE]
    """The picture: .exr."""
    environment: Annotated[Path | None, Role.INPUT] = None
    """Lat-long environment map, .exr or .hdr."""
    capture: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """The capture of these maps: its images add what a model of the maps lacks, such as interreflection."""
    display: Annotated[Path | None, Role.RUN, Spelling(metavar="FILE.png")] = None
    """Write the picture as a display shows it too, as PNG of 8 bits, as `view` and `look` say."""
