"""What `relit relight` takes."""

from enum import StrEnum
from pathlib import Path

from pydantic import Field

from service.requests.base import Request, StackOptions
from service.requests.picture import PictureOptions


class LightWeights(StrEnum):
    """How light from between the captured lights is shared out over them."""

    CELLS = "cells"
    """Whole to the nearest light."""
    SMOOTH = "smooth"
    """To the three lights around it."""


class RelightOptions(PictureOptions, StackOptions):
    """Which frames, and how light is shared out over the captured lights."""

    frames: str | None = None
    """A number, or first-last; None: 1, or 1 to the number of time steps."""
    weights: LightWeights | None = None
    """How light from between the captured lights is shared out over them; None: cells, with maps smooth."""
    spin_degrees: float = Field(default=0.0, allow_inf_nan=False)
    """How far the environment turns about +y over the whole range; the first frame is unturned, and a full turn closes."""


class RelightRequest(RelightOptions, Request):
    """Frames of a capture, or of a sequence of captures, under lat-long environments and animated lights."""

    capture: Path
    """A folder with a capture.json; or with such folders, one a time step: in order of name, each gives one frame."""
    out: str
    """Path of the frames with #### for the number."""
    environment: Path | None = None
    """A lat-long map; with #### in its name one a frame."""
    keys: Path | None = None
    """Light keys (schema relit.keys/1): animation of lights, environment, captured images and exposure."""
    only: str | None = None
    """Of `frames`, the part that this run makes, in the same form: what a farm gives to one of its machines. None: all."""
    maps: Path | None = None
    """Folder of the solved maps (of a sequence: of a folder a time step, named as its capture): frames are guided by a model of them."""
    overwrite: bool = False
    """Make frames anew that an equal request has made already."""
    sheet: Path | None = None
    """A PNG that shows the frames for review."""
    report: Path | None = None
    """A JSON file that says what was made, and where the time went."""

    @property
    def weighting(self) -> LightWeights:
        """The weights that are used."""
        return self.weights or (LightWeights.CELLS if self.maps is None else LightWeights.SMOOTH)
