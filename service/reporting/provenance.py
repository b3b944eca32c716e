"""Provenance: the attributes in EXR and USD files that say what a result was made from, and the text of reports."""

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from service import __version__
from service.requests.base.base import Options, Role
from service.requests.base.options import role_of
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, Manifest, read_manifest
from stage.colour.configuration import current
from stage.errors import ResultError
from stage.stack.ingest import LAYOUT

REPORTED = ("relit", "warp-lang", "numpy", "OpenEXR", "OpenImageIO", "opencolorio", "opencv-python-headless", "usd-core")
"""The distributions whose versions a report names."""
REPORT_FILE = "report.json"
COLOURS, CACHE_ID = "OpenColorIO configuration", "OpenColorIO cache id"
"""The entries of a report with the name of the configuration of colours and the version or the hash that tells its content, and with the
cache id that OpenColorIO gives it."""
HASHING = "relit:hashing"
"""Attribute of maps with the version of the stack cache by which `relit:inputs` was hashed: each version hashes otherwise."""
LIGHTS = "relit:declared_lights"
"""Attribute of maps with the content hash of the lights that the manifest declared."""

_names: ContextVar[dict[str, str] | None] = ContextVar("names of places", default=None)

UNREPORTED = (Role.OUTPUT, Role.FILE, Role.MACHINE, Role.PART)
"""Roles of fields that a report does not repeat."""


def versions() -> dict[str, str]:
    """Return the versions of this program and of the libraries that its results depend on, and the configuration of colours."""
    found = {"python": platform.python_version()}
    for name in REPORTED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = __version__ if name == "relit" else "not installed"
    return found | {COLOURS: current().label}


def reported_versions() -> dict[str, str]:
    """Return the versions as reports have them: with OpenColorIO's cache id, which differs between folders with the same configuration."""
    return versions() | {CACHE_ID: current().cache_id}


def colour_configuration() -> dict[str, str]:
    """Return the name and the cache id of the colour configuration, as string attributes of result files."""
    return {"relit:ocio": current().label, "relit:ocio_cache_id": current().cache_id}


def metadata(request: Options, *, capture: str, inputs: str, method: str | None = None, near_lights: int = 0,
             contents: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return string attributes for result files. They are equal for two runs on the same inputs, wherever those are
    made; OpenColorIO's cache id is that of a configuration in one place.

    Args:
        inputs: content hash of the images.
        method: the one that was used, where the request left the choice open.
        near_lights: how many point lights were taken as distant ones.
        contents: content hash of each file or capture that was read beside the images, by the name of its option.
    """
    options = {name: value for name, value in choices(request).items() if value is not None and value is not False}
    if method is not None:
        options["method"] = str(method)
    options.update(contents or {})
    found = {"relit:version": __version__, "relit:capture": capture, "relit:inputs": inputs,
             "relit:options": json.dumps(options, sort_keys=True), **colour_configuration()}
    if near_lights:
        found["relit:lights"] = f"{near_lights} near lights taken as distant, as the object's centre sees them"
    return found


def other_inputs(provenance: Mapping[str, str], inputs: str, maps: Path) -> str | None:
    """Return the sentence for maps of which nothing tells whether they were solved from the images with this content hash.

    None: they were. Maps that were solved from other images raise a ResultError.
    """
    if provenance.get("relit:inputs", inputs) == inputs:
        return None
    if provenance.get(HASHING) == str(LAYOUT):
        raise ResultError(f"{maps}: was solved from other images than the capture has, or with other alignment: solve it again")
    return (f"{maps}: was solved by another version of relit ({HASHING} {provenance.get(HASHING, 'is missing')}, here {LAYOUT}), which "
            "hashed images otherwise, so that nothing tells whether they are those of the capture: solve it again if in doubt")


def hash_of_lights(manifest: Manifest) -> str:
    """Return the content hash of the lights that a manifest declares, frame by frame."""
    declared = [None if frame.light is None else frame.light.model_dump(mode="json") for frame in manifest.frames]
    return hashlib.sha256(json.dumps(declared).encode()).hexdigest()


def other_manifest(camera: Camera, provenance: Mapping[str, str], capture: Capture, path: Path) -> str | None:
    """Return the sentence for maps with this camera and provenance, read from a path, of a capture whose manifest had another camera or
    other lights; None: the same."""
    differs = [f"another camera.{name}" for name, value in camera if value != getattr(capture.camera, name)]
    lights = hash_of_lights(read_manifest(capture.folder / FILE_NAME))  # as declared: a capture as solved has brighter lights
    differs += ["other lights"] if provenance.get(LIGHTS, lights) != lights else []
    return None if not differs else (f"{path}: was solved with {', '.join(differs)} than the manifest of the capture has now: solve it "
                                     "again, or what the maps say does not fit the images")


def export_metadata(request: Options, contents: Mapping[str, str]) -> dict[str, str]:
    """Return the string attributes that an export adds to the provenance of what it exports.

    `contents` is the content hash of each file that the asset was made from, by the name of its stem, such as maps.
    """
    options = {name: value for name, value in choices(request).items() if value is not None and value is not False}
    return {"relit:export_version": __version__, "relit:export_options": json.dumps(options, sort_keys=True),
            **{f"relit:{name}": content for name, content in contents.items()}}


def choices(request: Options) -> dict[str, Any]:
    """Return what a request chooses about the work, as plain data; neither paths nor how the work was carried out."""
    plain = request.model_dump(mode="json")
    return {name: choices(value) if isinstance(value := getattr(request, name), Options) else plain[name]
            for name, field in type(request).model_fields.items() if role_of(field) is Role.CHOICE}


def requested(request: Options) -> dict[str, Any]:
    """Return the options of a report, as plain data: the request without where it was carried out and the part of the work done.

    The folders of a service are nobody's business who reads a report; the device has an entry of its own.
    """
    left_out = {name for name, field in type(request).model_fields.items() if role_of(field) in UNREPORTED}
    return request.model_dump(mode="json", exclude=left_out)


def report(request: Options, *, inputs: Mapping[str, Any], **sections: Any) -> str:
    """Return the text of a report.json: inputs, options, the other sections in the order given, and software versions."""
    text = json.dumps({"schema": "relit.report/1", "inputs": inputs, "options": requested(request), **sections,
                       "versions": reported_versions()}, indent=2) + "\n"
    return with_names(text)


def with_names(text: str) -> str:
    """Return the text of a JSON file with the names that `name_place` gave in place of paths."""
    for path, name in sorted((_names.get() or {}).items(), key=lambda item: -len(item[0])):  # a folder after what lies in it
        text = text.replace(json.dumps(path)[1:-1], name)
    return text


@contextmanager
def places_named() -> Iterator[None]:
    """Let reports that are made within this context write the names that `name_place` gives in place of paths."""
    token = _names.set({})
    try:
        yield
    finally:
        _names.reset(token)


def name_place(path: Path, name: str) -> None:
    """Give a file or folder of the server the name by which the user of the service knows it; outside `places_named` it has no effect."""
    names = _names.get()
    if names is not None:
        names[str(path)] = name
