"""The options of `relit info` and `relit view`."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from service.requests.base.base import CAPTURE, PixelOptions, Request, Role, Spelling, StackOptions
from service.requests.base.review import ReviewOptions

MOST_TERMS = 256
"""Layers that a texture of any browser with WebGL2 can have (OpenGL ES 3.0, table 6.29)."""


def _png(path: Path | None) -> Path | None:
    if path is not None and path.suffix.lower() != ".png":
        raise ValueError(f"{path} is no PNG: end the name in .png")
    return path


class InfoRequest(ReviewOptions, PixelOptions):
    """Say what a capture holds, and what is wrong with it."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json."""
    picture: Annotated[Path | None, AfterValidator(_png), Role.FILE] = None
    """PNG that shows what was understood: the lights on the dome with their images, those that disagree with the others in red, the mask,
    and how bright the readings are."""


class ViewOptions(StackOptions):
    """Options for showing a capture."""

    terms: Annotated[int, Field(ge=1, le=MOST_TERMS)] | None = None
    """Most coefficient images that the object is relit with in the browser; fewer where fewer show the object as well. More are closer to
    `relit relight` where highlights and shadows are sharp. None: 32."""


class ViewRequest(ViewOptions, Request):
    """Write the files that a browser needs to show a capture, its maps, its object under new light, and its depth as points."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json."""
    maps: Annotated[Path | None, Role.INPUT, Spelling(metavar="DIR")] = None
    """Folder with the maps.exr or depth.exr of the capture, or the file; None: the capture alone is shown."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for view.json, view.bin, thumbnails.jpg and the pictures of the card."""
