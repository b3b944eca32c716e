"""The layouts of `relit import` that make one capture, and their options by name, as a guess proposes them and a person chooses them."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import Field, ValidationError

from service.requests.base.base import Options
from service.requests.base.options import Option, places_of
from service.requests.imports.base import ImportRequest
from service.requests.imports.lights import DiligentImport, LpImport, NearLightsImport, OlatImport, PhotosImport, RelightlabImport
from service.requests.imports.patterns import GrayImport, LaserImport, OpencvGrayImport, PhaseImport, ScannerImport
from service.requests.imports.tof import HistogramImport, KinectImport, TofImport
from stage.model import Line

Layout = Literal["diligent", "lp", "relightlab", "olat", "photos", "near-lights", "opencv-gray", "gray", "phase", "scanner", "tof",
                 "histogram", "kinect", "laser"]
LAYOUTS: dict[str, type[ImportRequest]] = dict(zip(get_args(Layout), (
    DiligentImport, LpImport, RelightlabImport, OlatImport, PhotosImport, NearLightsImport, OpencvGrayImport, GrayImport, PhaseImport,
    ScannerImport, TofImport, HistogramImport, KinectImport, LaserImport), strict=True))
"""The request of each layout."""


class ImportChoices(Options):
    """How the files of a capture are laid out, and the options of that import."""

    layout: Layout
    """The word behind relit import."""
    file: Line | None = None
    """The file of the capture that is imported, such as a light list; None: all of them."""
    options: Annotated[dict[str, Any], Field(default_factory=dict)]
    """The options of the import by the names of docs/importing.md, with _ for -: {"color_space": "lin_rec709_scene"}. Files are named as
    in the capture."""


class Typed(NamedTuple):
    """The arguments of `relit import`, taken apart."""

    layout: str
    source: Path
    options: dict[str, Any]
    """Texts by the names of fields, and True for a switch."""


def options_of_layout(layout: str) -> dict[str, Option]:
    """Return the options of a layout by the names of fields, without the folders."""
    return {path[0]: option for path, option in places_of(LAYOUTS[layout]) if not option.spelling.argument}


def taken_apart(arguments: Sequence[str]) -> Typed:
    """Return the layout, the source and the options of arguments as a guess gives them."""
    layout, source, *words = arguments
    flags = {option.flag: name for name, option in options_of_layout(layout).items()}
    found: dict[str, Any] = {}
    for word, after in zip(words, [*words[1:], "--"], strict=False):
        if word in flags:
            found[flags[word]] = True if after.startswith("--") else after
    return Typed(layout, Path(source), found)


def request_of(layout: str, source: Path, destination: Path | None, options: Mapping[str, Any]) -> ImportRequest:
    """Return the request of an import; pydantic's ValidationError names the field of a value that cannot be."""
    return LAYOUTS[layout].model_validate({**options, "source": source, "destination": destination})


def unsettled(layout: str, options: Mapping[str, Any]) -> list[str]:
    """Return the names of the options that have no value but need one, or whose text, such as FOCAL, stands for a value."""
    try:
        request_of(layout, Path(), None, options)
    except ValidationError as error:
        return list(dict.fromkeys(str(fault["loc"][0]) for fault in error.errors() if fault["loc"]))
    return []


def leads_out(value: Any) -> bool:
    """Return whether a text, or one within a value, would name a file outside the folder of a capture."""
    if isinstance(value, str):
        return PurePath(value).is_absolute() or ".." in value.replace("\\", "/").split("/")
    return isinstance(value, list | tuple) and any(map(leads_out, value))
