"""How a person wants the files of a capture imported."""

from typing import Annotated, Any, Literal

from pydantic import Field

from service.requests.base.base import Options
from stage.model import Line

Layout = Literal["diligent", "lp", "relightlab", "olat", "photos", "near-lights", "opencv-gray", "gray", "phase", "scanner", "tof",
                 "histogram", "kinect", "laser"]


class ImportChoices(Options):
    """How the files of a capture are laid out, and the options of that import."""

    layout: Layout
    """The word behind relit import."""
    file: Line | None = None
    """The file of the capture that is imported, such as a light list; None: all of them."""
    options: Annotated[dict[Line, Any], Field(default_factory=dict)]
    """The options of the import by the names of docs/importing.md, with _ for -: {"color_space": "lin_rec709_scene"}. Files are named as
    in the capture."""
