"""What `relit join` takes."""

from pathlib import Path
from typing import Annotated

from service.requests.base import Request, Role, Spelling


class JoinRequest(Request):
    """One surface from solved maps and a depth of the same view: the detail of the normals, and the shape and place of the depth."""

    maps: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="MAPS")]
    """Folder with the maps.exr of `relit solve`, or the file."""
    depth: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="DEPTH")]
    """Folder with the depth.exr of `relit depth` by the same camera from the same place, or the file."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for maps.exr and report.json."""
