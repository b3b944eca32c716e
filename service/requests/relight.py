"""The options of `relit relight`."""

from pathlib import Path
from typing import Annotated

from service.requests.base.base import CAPTURE, Choice, Request, Role, Spelling, StackOptions
from service.requests.base.review import ReviewOptions
from service.requests.light.picture_options import FrameRate, PictureOptions
from stage.model import Finite, Line

CHUNK_FRAMES = 32
"""Most frames that are computed in one pass over the images: with more the product takes no less time for each frame, and writing begins
later. A task of a render farm makes as many by default: with fewer, images are read more often."""


class LightWeights(Choice):
    """The rule that shares out light from a direction between the captured lights over them."""

    KERNEL = "kernel", "so that the expected error of the frame is least"
    CELLS = "cells", "all of it to the nearest light"
    SMOOTH = "smooth", "in parts to the three lights around it"


class RelightOptions(PictureOptions, StackOptions):
    """The frames to relight, and how light is shared out over the captured lights."""

    frames: Line | None = None
    """A number, or first-last; None: 1, or for a sequence 1 to the number of its time steps."""
    weights: LightWeights | None = None
    """How light from a direction between the captured lights is shared out over them; None: smooth where solved maps guide the frames,
    else kernel."""
    spin_degrees: Finite = 0.0
    """Degrees by which the environment turns over the range, about +y from +z towards +x; the first frame is not turned, and with 360 the
    frame after the last would be the first again."""
    frames_per_second: FrameRate | None = None
    """Frames per second, which the frames record with their time code; None: those of the light keys, else 24."""


class RelightRequest(ReviewOptions, RelightOptions, Request):
    """Frames under HDR environments and animated lights."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json; or a sequence: a folder with such folders, one for each time step, which give one frame each in the order
    of their names."""
    out: Annotated[str, Role.FILE]
    """Path of the frames, with #### for the number."""
    environment: Annotated[Path | None, Role.INPUT] = None
    """Lat-long environment map, .exr or .hdr; with #### in its name, a map for each frame."""
    keys: Annotated[Path | None, Role.INPUT, Spelling(metavar="FILE")] = None
    """Light keys (JSON, schema relit.keys/1): animated lights, environment, captured images and exposure; docs/relight.md."""
    only: Annotated[Line | None, Role.PART, Spelling(metavar="FRAMES")] = None
    """Make only this part of `frames`, such as 9-16: a farm gives each machine such a part; None: all."""
    maps: Annotated[Path | None, Role.INPUT, Spelling(metavar="DIR")] = None
    """Folder of the solved maps, which guide the frames: light from between the captured lights is taken from a model of the maps, as far
    as the captured images confirm the model. For a sequence, a folder with one such folder for each capture, of the same name."""
    overwrite: Annotated[bool, Role.RUN] = False
    """Make every frame again. Without it, frames are kept that an earlier run made from the same inputs and options."""
    display: Annotated[Line | None, Role.RUN, Spelling(metavar="FILE.####.png")] = None
    """Write each frame as a display shows it too, as PNG of 8 bits, as `view` and `look` say."""
    sheet: Annotated[Path | None, Role.RUN, Spelling(metavar="FILE.png")] = None
    """Write a contact sheet of the frames, for review, as `view` and `look` say."""
    nuke: Annotated[Path | None, Role.RUN, Spelling(metavar="FILE.nk")] = None
    """Write a script of Nuke that reads the frames and mixes their layers of lights, each with a gain; needs `--aov lights`."""
    report: Annotated[Path | None, Role.RUN, Spelling(metavar="FILE.json")] = None
    """Write a report: what was made, and how long each part of the work took."""

    @property
    def used_weights(self) -> LightWeights:
        """Return the weights that are used."""
        return self.weights or (LightWeights.KERNEL if self.maps is None else LightWeights.SMOOTH)
