"""What `relit shade` takes."""

from pathlib import Path
from typing import Annotated

from service.requests.base import PixelOptions, Request, Role, Spelling
from service.requests.near_lights import POINT_FORM, RECTANGLE_FORM, SPHERE_FORM, GivenPoint, GivenRectangle, GivenSphere
from service.requests.picture import PictureOptions
from stage.model import Finite, FirstFault


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


class ShadeRequest(ShadeOptions, Request):
    """A picture of solved maps under near lights, area lights and an environment, with cast shadows."""

    maps: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="DIR")]
    """Folder with maps.exr, or the file."""
    out: Annotated[Path, Role.OUTPUT]
    """The picture: .exr."""
    environment: Annotated[Path | None, Role.INPUT] = None
    """Lat-long environment map, .exr or .hdr."""
    capture: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """The capture of these maps: its images add what a model of the maps lacks, such as interreflection."""
