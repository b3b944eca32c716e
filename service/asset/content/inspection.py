"""The findings about an asset for relit inspect, alike for every format."""

import tempfile
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import OpenImageIO as oiio


class Part(NamedTuple):
    """One row of the table of what an asset holds."""

    kind: str  # mesh, points, material, texture, light or camera
    name: str  # its path or name, of a texture with the input that reads it
    variant: str  # set=variant, where it is not there with the first selections; else empty
    facts: Mapping[str, Any]


class Inspection(NamedTuple):
    """Contents and faults of an asset."""

    file: str
    size_bytes: int  # with all files that it refers to
    facts: dict[str, Any]  # what holds for the asset as a whole
    parts: tuple[Part, ...]
    provenance: dict[str, str]
    warnings: tuple[str, ...]
    errors: tuple[str, ...]


def image_facts(data: bytes, name: str) -> dict[str, Any]:
    """Return the size of an image and the type of its values, or its bytes alone where it cannot be read."""
    with tempfile.NamedTemporaryFile(suffix=PurePosixPath(name).suffix) as file:
        file.write(data)
        file.flush()
        image = oiio.ImageInput.open(file.name)
    if image is None:
        oiio.geterror()  # else OpenImageIO prints it at the end of the program
        return {"bytes": len(data)}
    spec = image.spec()
    image.close()
    return {"bytes": len(data), "resolution": [spec.width, spec.height], "channels": spec.nchannels, "depth": str(spec.format)}
