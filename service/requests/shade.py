"""What `relit shade` takes."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base import Request
from service.requests.near_lights import GivenPoint, GivenRectangle, GivenSphere
from service.requests.picture import PictureOptions
from stage.model import FirstFault


class ShadeOptions(PictureOptions):
    """Lights near the surface, and how its environment is turned."""

    light: Annotated[tuple[GivenPoint, ...], FirstFault] = ()
    sphere: Annotated[tuple[GivenSphere, ...], FirstFault] = ()
    rectangle: Annotated[tuple[GivenRectangle, ...], FirstFault] = ()
    turn_degrees: float = Field(default=0.0, allow_inf_nan=False)
    """Of the environment about +y, +z towards +x."""


class ShadeRequest(ShadeOptions, Request):
    """One picture of solved maps under near lights, area lights and an environment."""

    maps: Path
    """A folder with maps.exr, or the file."""
    out: Path
    """.exr."""
    environment: Path | None = None
    """A lat-long map."""
    capture: Path | None = None
    """The capture of the maps: its images give what a model of the maps cannot, interreflection and scattering."""
