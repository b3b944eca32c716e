"""What `relit shade` takes."""

from pathlib import Path
from typing import Annotated

from service.requests.base import Request, Role, Spelling
from service.requests.near_lights import POINT_FORM, RECTANGLE_FORM, SPHERE_FORM, GivenPoint, GivenRectangle, GivenSphere
from service.requests.picture import PictureOptions
from stage.model import Finite, FirstFault


class ShadeOptions(PictureOptions):
    """Lights near the surface, and how its environment is turned."""

    light: Annotated[tuple[GivenPoint, ...], FirstFault, Spelling(metavar=POINT_FORM)] = ()
    """A point light: place in metres, camera frame, and intensity; with a lobe its axis and exponent. Any number of them."""
    sphere: Annotated[tuple[GivenSphere, ...], FirstFault, Spelling(metavar=SPHERE_FORM)] = ()
    """A sphere light: centre, radius, radiance. Any number of them."""
    rectangle: Annotated[tuple[GivenRectangle, ...], FirstFault, Spelling(metavar=RECTANGLE_FORM)] = ()
    """A rectangle light: centre, its two edges, radiance; it shines against u x v, as a USD RectLight does. Any number of them."""
    turn_degrees: Finite = 0.0
    """How far the environment is turned about +y, +z towards +x."""


class ShadeRequest(ShadeOptions, Request):
    """A picture of solved maps under near lights, area lights and an environment, with cast shadows."""

    maps: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="DIR")]
    """Folder with maps.exr, or the file."""
    out: Annotated[Path, Role.OUTPUT]
    """The picture: .exr."""
    environment: Annotated[Path | None, Role.INPUT] = None
    """Lat-long .exr or .hdr."""
    capture: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """The capture of these maps: its images bring what a model of the maps lacks, such as interreflection."""
