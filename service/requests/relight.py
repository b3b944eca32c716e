"""What `relit relight` takes."""

from pathlib import Path
from typing import Annotated

from service.requests.base import Choice, Request, Role, Spelling, StackOptions
from service.requests.picture import PictureOptions
from stage.model import Finite

CHUNK_FRAMES = 32
"""Most frames that are computed in one pass over the images: with more the product takes no less time for each frame, and writing begins
later. A task of a render farm makes as many by default: with fewer, images are read more often."""


class LightWeights(Choice):
    """How light from between the captured lights is shared out over them."""

    CELLS = "cells", "whole to the nearest light"
    SMOOTH = "smooth", "to the three lights around it"


class RelightOptions(PictureOptions, StackOptions):
    """Which frames, and how light is shared out over the captured lights."""

    frames: str | None = None
    """A number, or first-last; None: 1, or 1 to the number of time steps."""
    weights: LightWeights | None = None
    """How light from between the captured lights is shared out over them; None: cells, with maps smooth."""
    spin_degrees: Finite = 0.0
    """How far the environment turns about +y, +z towards +x, over the whole range; the first frame is unturned, and a full turn closes."""


class RelightRequest(RelightOptions, Request):
    """Frames under HDR environments and animated lights."""

    capture: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="CAPTURE")]
    """Folder with a capture.json; or with such folders, one a time step: in order of name, each gives one frame."""
    out: Annotated[str, Role.OUTPUT]
    """Path of the frames, #### for the number."""
    environment: Annotated[Path | None, Role.INPUT] = None
    """Lat-long .exr or .hdr; with #### in its name one a frame."""
    keys: Annotated[Path | None, Role.INPUT, Spelling(metavar="FILE")] = None
    """Light keys (JSON, schema relit.keys/1): animated lights, environment, captured images and exposure; docs/relight.md."""
    only: Annotated[str | None, Role.RUN, Spelling(metavar="FRAMES")] = None
    """Make this part of `frames` alone, such as 9-16: what a farm gives to one machine; None: all."""
    maps: Annotated[Path | None, Role.INPUT, Spelling(metavar="DIR")] = None
    """Folder of the solved maps: what lies between the captured lights is taken from a model of them, as far as it proves right.
    For a sequence with one folder a capture in it, named as the capture."""
    overwrite: Annotated[bool, Role.RUN] = False
    """Make every frame; else those that an equal run has made already are kept."""
    sheet: Annotated[Path | None, Role.RUN, Spelling(metavar="FILE.png")] = None
    """Contact sheet of the frames, for review."""
    report: Annotated[Path | None, Role.RUN, Spelling(metavar="FILE.json")] = None
    """A report of what was made, and where the time went."""

    @property
    def weighting(self) -> LightWeights:
        """Return the weights that are used."""
        return self.weights or (LightWeights.CELLS if self.maps is None else LightWeights.SMOOTH)
