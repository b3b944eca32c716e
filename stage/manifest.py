"""capture.json: the manifest of one capture, schema relit.capture/1, checked by name before any pixel is read."""

import json
import posixpath
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from stage.camera import Camera
from stage.colour import ColorSpaceName
from stage.errors import ManifestError, storage
from stage.files import write_text
from stage.light import Light
from stage.model import Positive, Strict, Text
from stage.pattern import Pattern
from stage.projector import Projector
from stage.ranging import Laser, TimeOfFlight

SCHEMA = "relit.capture/1"
FILE_NAME = "capture.json"

FileName = Text
"""A file of the capture, relative to its folder."""


class Frame(Strict):
    """One image and exactly one thing that lit it."""

    image: FileName
    exposure_s: Positive | None = None
    light: Light | None = None
    pattern: Pattern | None = None
    laser: Laser | None = None
    tof: TimeOfFlight | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [name for name in ("light", "pattern", "laser", "tof") if getattr(self, name) is not None]
        if len(given) != 1:
            what = " and ".join(given) or "nothing that lit it"
            raise ValueError(f"has {what}: give exactly one of light, pattern, laser, tof")
        return self


class Manifest(Strict):
    """Everything capture.json says."""

    schema_: Literal["relit.capture/1"] = Field(alias="schema")
    name: Text
    color_space: ColorSpaceName = "lin_rec709_scene"
    camera: Camera
    projector: Projector | None = None
    mask: FileName | None = None
    dark: FileName | None = None
    flat: FileName | None = None
    saturation: Positive | None = None
    frames: Annotated[tuple[Frame, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        first: dict[str, int] = {}
        for index, frame in enumerate(self.frames):
            name = posixpath.normpath(frame.image)
            if name in first:
                raise ValueError(f"frames[{index}].image: {frame.image} is already the image of frames[{first[name]}]")
            first[name] = index
        timed = [frame.exposure_s is not None for frame in self.frames]
        if any(timed) and not all(timed):
            raise ValueError(f"frames[{timed.index(False)}].exposure_s: is missing: give it for every frame or for none")
        return self


def read_manifest(path: str | Path) -> Manifest:
    """Read and check capture.json.

    Args:
        path: the file.

    Raises:
        StorageError: it cannot be read.
        ManifestError: not JSON, or a field is wrong; the message names file and field.
    """
    with storage("read", path):
        text = Path(path).read_bytes()
    try:
        data = json.loads(text, object_pairs_hook=_unique_keys, parse_constant=_refuse_constant)
    except UnicodeDecodeError as error:
        raise ManifestError(f"{path}: is not UTF-8 text") from error
    except json.JSONDecodeError as error:
        raise ManifestError(f"{path}: is not JSON: {error.msg} at line {error.lineno}, column {error.colno}") from error
    except RecursionError as error:
        raise ManifestError(f"{path}: is nested too deeply") from error
    except ValueError as error:
        raise ManifestError(f"{path}: {error}") from error
    if not isinstance(data, dict):
        raise ManifestError(f"{path}: must hold one JSON object")
    if "schema" not in data:
        raise ManifestError(f"{path}: schema: is missing: this program reads {SCHEMA}")
    schema = data["schema"]
    if schema != SCHEMA:
        raise ManifestError(f"{path}: schema: is {json.dumps(schema)}, this program reads {SCHEMA}")
    try:
        return Manifest.model_validate(data)
    except ValidationError as error:
        raise ManifestError(f"{path}: {describe(error)}") from error


def write_manifest(manifest: Manifest, path: str | Path) -> None:
    """Write capture.json, whole or not at all: `color_space` always, other keys unless they hold their default.

    Raises:
        StorageError: it cannot be written.
    """
    data = manifest.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    frames = ",\n".join("    " + json.dumps(frame) for frame in data.pop("frames"))
    first = {"schema": data.pop("schema"), "name": data.pop("name"), "color_space": manifest.color_space}
    body = json.dumps({**first, **data}, indent=2)
    write_text(path, body[:-2] + f',\n  "frames": [\n{frames}\n  ]\n}}\n')


def describe(error: ValidationError) -> str:
    """The first fault of a pydantic error as `field: what is wrong`, with a count of the others."""
    places = {fault["loc"][:n] for fault in error.errors() for n in range(len(fault["loc"]))}
    faults = [fault for fault in error.errors() if fault["loc"] not in places]  # not of a list what is said of its entries
    fault = faults[0]
    where = _field(fault["loc"])
    match fault["type"]:
        case "extra_forbidden":
            text = "is not a known key"
        case "missing":
            text = "is missing"
        case "value_error":
            text = str(fault["ctx"]["error"])
        case "union_tag_invalid":
            text = f"{fault['ctx']['discriminator'].strip(chr(39))} is {json.dumps(fault['ctx']['tag'])}, " \
                   f"must be one of {fault['ctx']['expected_tags']}"
        case "too_short":
            text = f"has {fault['ctx']['actual_length']} entries, needs {fault['ctx']['min_length']} or more"
        case "too_long":
            text = f"has {fault['ctx']['actual_length']} entries, must have {fault['ctx']['max_length']}"
        case "tuple_type":
            text = f"is {_short(fault['input'])}: must be a list"
        case "model_type" | "model_attributes_type":
            text = f"is {_short(fault['input'])}: must be an object"
        case "union_tag_not_found":
            text = f"lacks the key {fault['ctx']['discriminator'].strip(chr(39))}"
        case _:
            text = f"is {_short(fault['input'])}: {fault['msg'][0].lower()}{fault['msg'][1:]}"
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return f"{where}: {text}{more}" if where else f"{text}{more}"


def _field(location: tuple[int | str, ...]) -> str:
    """`frames[3].light.direction` from pydantic's location, which also names union members after their key."""
    text = ""
    previous: int | str = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part}]"
        elif previous not in ("light", "pattern", "laser", "tof"):
            text += f".{part}" if text else part
        previous = part
    return text


def _short(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            raise ValueError(f"key {key} is given twice in one object")
        result[key] = value
    return result


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")
