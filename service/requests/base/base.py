"""The base of every request: a frozen model whose fields are the only declaration of options, their defaults and their words.

An ...Options model holds what is chosen about the work; the ...Request on top of it adds where files are. A job of the service carries
the options and names of captures, which its worker makes paths of. `service.requests.base.options` reads the fields.
"""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from stage.model import Count, Line, NotNegativeCount, Positive
from stage.pixels import Crop, PixelChoices


def _split_commas(given: Any) -> Any:
    """Return the parts of a text with commas between them, and a list as a tuple, which strict validation of JSON asks for."""
    if isinstance(given, str):
        return tuple(part.strip() for part in given.split(","))
    return tuple(given) if isinstance(given, list) else given


def _sides(given: Any) -> Any:
    """Return the two numbers of a text such as 1280x800, and a list as a tuple, which strict validation of JSON asks for."""
    if not isinstance(given, str):
        return tuple(given) if isinstance(given, list) else given
    sides = given.lower().replace("×", "x").split("x")
    if len(sides) != 2 or not all(side.strip().isdigit() for side in sides):
        raise ValueError(f"is {given}: give width x height in pixels, as in 1280x800")
    return tuple(int(side) for side in sides)


Commas = BeforeValidator(_split_commas)
"""Marks a tuple whose values may be given as one text with commas between."""
WidthHeight = BeforeValidator(_sides)
"""Marks two numbers that may be given as one text with an x between."""

CropBox = tuple[NotNegativeCount, NotNegativeCount, Count, Count]
"""The first column, the first row, the width and the height of a rectangle of an image."""


class Role(StrEnum):
    """The role of a field in a request; written into `Annotated`, CHOICE where nothing is written."""

    CHOICE = "choice"
    """A choice about the work: it is recorded with the results, and `relit submit` and `relit farm template` have it too, for the commands
    that they do."""
    INPUT = "input"
    """A file or folder that is read."""
    OUTPUT = "output"
    """The folder of the results."""
    FILE = "file"
    """A file that is written."""
    MACHINE = "machine"
    """A choice of the machine: the device, and the folder for caches."""
    RUN = "run"
    """A choice about one run beside the work: all frames anew, a contact sheet, a report."""
    PART = "part"
    """The part of the work that one run does. It is recorded nowhere, so that results do not say how the work was divided."""


@dataclass(frozen=True, kw_only=True)
class Spelling:
    """The spelling of an option, where the rule does not say it."""

    flag: str | None = None
    """The flag, such as --filter, where it does not follow from the field's name."""
    off: str | None = None
    """The flag that turns a switch off, in place of --no-…."""
    metavar: str | None = None
    """The word that stands for the value in the help."""
    argument: bool = False
    """True if the value is given by its place, without a flag."""


CAPTURE = Spelling(argument=True, metavar="CAPTURE")
"""Marks the capture of a command, which is given by its place."""


class Choice(StrEnum):
    """A closed set of values, each with the words that explain it: `ZIP = "zip", "keeps every bit"`."""

    words: str

    def __new__(cls, value: str, words: str = "") -> Self:
        """Make a value with the words that explain it; none where the value says enough."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.words = words
        return member

    @classmethod
    def explained(cls) -> str:
        """Return the values that have words, with them, as one line."""
        return "; ".join(f"{member}: {member.words}" for member in cls if member.words)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON schema of the set, which explains its values too."""
        schema = handler.resolve_ref_schema(handler(core))
        if explained := cls.explained():
            schema["description"] = f"{schema.get('description', '')} {explained}.".strip()
        return schema


class Options(BaseModel):
    """Base of every model; unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, defer_build=True)


class DeviceRequest(Options):
    """Base of the requests whose work is done on a device."""

    device: Annotated[Line | None, Role.MACHINE] = None
    """cpu, cuda:0, …; None: the first CUDA device, else the CPU."""


class Request(DeviceRequest):
    """Base of the requests that read images through a stack, which is cached."""

    cache: Annotated[Path | None, Role.MACHINE] = None
    """Folder for the image stack; None: .relit in the capture's folder."""


class SequenceOptions(Options):
    """Options for joining the steps of a sequence of captures."""

    temporal: Annotated[bool, Role.RUN] = True
    """Join the estimates of consecutive steps of a sequence where they agree within their standard deviations."""
    frame_rate: Annotated[Positive | None, Role.RUN] = None
    """Steps per second of a sequence without a sequence.json; None: 24."""


class SequenceRequest(SequenceOptions, Request):
    """Base of the requests that take a capture, or a sequence of captures."""


class PixelOptions(Options):
    """Options for reading the pixels of images."""

    clip_negative: bool = False
    """Set values to 0 that are negative beyond the noise of their image, and say how many; without it such images are refused. Noise around
    zero, as dark-subtracted images have, is kept in either case."""
    crop: Annotated[CropBox | None, Commas, Spelling(metavar="X,Y,W,H")] = None
    """Use this part of every image alone: first column, first row, width and height in pixels. The camera and the mask follow."""

    @property
    def pixels(self) -> PixelChoices:
        """Return how the pixels of the capture are read."""
        return PixelChoices(self.clip_negative, None if self.crop is None else Crop(*self.crop))


class StackOptions(PixelOptions):
    """Options for aligning the images of a capture."""

    align: bool = False
    """The subject moves: warp every frame to the time of the middle tracking frame (light type full). The mask belongs to that time."""
    align_to: Annotated[Line | None, Spelling(metavar="IMAGE")] = None
    """As `align`, but to the time of this tracking frame."""

    @property
    def aligned(self) -> bool:
        """Return whether frames are warped."""
        return self.align or self.align_to is not None


class JobRequest(Options):
    """Base of every job."""

    name: Annotated[str, Field(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$"), Role.RUN, Spelling(flag="--job-name", metavar="TEXT")] = ""
    """Name of the job, shown in lists; it need not be unique."""
    priority: Annotated[int, Field(ge=0, le=100), Role.RUN] = 50
    """0 to 100: jobs of higher priority are done first, those of equal priority in the order of submission."""
