"""The requests of the layouts of `relit import` that make one capture, and their options by name, as a guess proposes them."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from pydantic import ValidationError

from service.requests.base.options import Option, places_of
from service.requests.imports.base import ImportRequest
from service.requests.imports.lights import DiligentImport, LpImport, NearLightsImport, OlatImport, PhotosImport, RelightlabImport
from service.requests.imports.patterns import GrayImport, LaserImport, OpencvGrayImport, PhaseImport, ScannerImport
from service.requests.imports.tof import HistogramImport, KinectImport, TofImport

LAYOUTS: dict[str, type[ImportRequest]] = {
    "diligent": DiligentImport, "lp": LpImport, "relightlab": RelightlabImport, "olat": OlatImport, "photos": PhotosImport,
    "near-lights": NearLightsImport, "opencv-gray": OpencvGrayImport, "gray": GrayImport, "phase": PhaseImport, "scanner": ScannerImport,
    "tof": TofImport, "histogram": HistogramImport, "kinect": KinectImport, "laser": LaserImport}
"""The request of each layout."""


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
