"""The metadata of a result file: the camera, and the provenance as texts whose names begin with `relit:`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from stage.camera import Camera
from stage.errors import ResultError

PREFIX, CAMERA = "relit:", "relit:camera"


def result_metadata(camera: Camera, provenance: Mapping[str, str]) -> dict[str, str]:
    """Return the string attributes of a result file."""
    return {CAMERA: camera.model_dump_json(), **provenance}


def camera_and_provenance(metadata: Mapping[str, Any], path: str | Path, *, file_name: str) -> tuple[Camera, dict[str, str]]:
    """Return the camera and the provenance from the attributes of a result file.

    Args:
        metadata: the attributes of the file.
        path: the file, for the message.
        file_name: the name of such files, for the message: maps.exr or depth.exr.

    Raises:
        ResultError: the camera is missing or invalid.
    """
    if CAMERA not in metadata:
        raise ResultError(f"{path}: carries no {CAMERA} attribute, so it is not a {file_name} of relit")
    try:
        camera = Camera.model_validate_json(str(metadata[CAMERA]))
    except ValidationError as error:
        raise ResultError(f"{path}: its {CAMERA} attribute is not a camera") from error
    return camera, {name: value for name, value in metadata.items() if name.startswith(PREFIX) and name != CAMERA}
