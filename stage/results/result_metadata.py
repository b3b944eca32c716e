"""Result files: how they are given, and their metadata, the camera and the provenance as texts whose names begin with `relit:`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from stage.capture.camera import Camera
from stage.errors import ResultError
from stage.folders import advice

PREFIX, CAMERA = "relit:", "relit:camera"


def result_metadata(camera: Camera, provenance: Mapping[str, str]) -> dict[str, str]:
    """Return the string attributes of a result file."""
    return {CAMERA: camera.model_dump_json(), **provenance}


def camera_and_provenance(metadata: Mapping[str, Any], path: str | Path, *, file_name: str) -> tuple[Camera, dict[str, str]]:
    """Return the camera and the provenance from the attributes of a result file."""
    if CAMERA not in metadata:
        raise ResultError(f"{path}: carries no {CAMERA} attribute, so it is not a {file_name} of relit")
    try:
        camera = Camera.model_validate_json(str(metadata[CAMERA]))
    except ValidationError as error:
        raise ResultError(f"{path}: its {CAMERA} attribute is not a camera") from error
    return camera, {name: value for name, value in metadata.items() if name.startswith(PREFIX) and name != CAMERA}


def result_file(given: Path, name: str, *, command: str) -> Path:
    """Return a result file that is given as itself or by its folder."""
    file = given / name if given.is_dir() else given
    if not file.is_file():
        raise ResultError(f"{file}: is not there: {advice(given, f'run `{command}` first', of_result=True)}")
    return file
