"""What `relit import` takes."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import model_validator

from service.errors import RequestError
from service.requests.base import Choice, Options, Role, Spelling, WidthHeight
from stage.model import Positive, Resolution


class ImportFormat(Choice):
    """Layouts that relit reads."""

    DILIGENT = "diligent", "an object's folder of the DiLiGenT benchmark"
    LP = "lp", "an RTI light list with its images"
    OPENCV_GRAY = "opencv-gray", "images of a Gray code in OpenCV's order"


class ImportRequest(Options):
    """Write a capture.json for data laid out another way."""

    format: Annotated[ImportFormat, Spelling(argument=True, metavar="FORMAT")]
    """How the data is laid out."""
    source: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SRC")]
    """Folder of the data, or the .lp file."""
    destination: Annotated[Path, Role.OUTPUT, Spelling(argument=True, metavar="DST")]
    """Folder for the capture; may be SRC."""
    projector: Annotated[Resolution | None, WidthHeight, Spelling(metavar="1280x800")] = None
    """opencv-gray: width and height of the projector in pixels."""
    calibration: Annotated[Path | None, Role.INPUT] = None
    """opencv-gray: OpenCV file (.yml, .xml, .json) with the intrinsics of camera and projector, R and T; relit calibrate procam
    measures them without such a file."""
    unit_m: Positive = 1.0
    """opencv-gray: metres in one unit of T, such as 0.001 for millimetres."""

    @model_validator(mode="after")
    def _options_of_the_format(self) -> Self:
        if self.format is ImportFormat.OPENCV_GRAY:
            if self.projector is None:
                raise RequestError("--projector is missing: opencv-gray needs the projector's pixels to know how many bits there are")
        elif self.projector is not None or self.calibration is not None or self.unit_m != 1.0:
            raise RequestError(f"--projector, --calibration and --unit-m are for opencv-gray, the format is {self.format}")
        return self
