"""What `relit scan` takes."""

from pathlib import Path
from typing import Annotated

from service.requests.base import DeviceRequest, Options, Role, Spelling
from stage.model import Positive


class ScanOptions(Options):
    """Which returns count, and what is written."""

    near_m: Positive | None = None
    """Returns nearer than this, in metres, are left out."""
    far_m: Positive | None = None
    """Returns farther than this, in metres, are left out."""
    las: bool = False
    """Write points.las (LAS 1.4) too; needs laspy: pip install 'relit[las]'."""


class ScanRequest(ScanOptions, DeviceRequest):
    """Shots of a scanning laser, from a platform that may move, as one point cloud."""

    scan: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SCAN")]
    """A folder with a scan.json, or the file."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for points.ply, points.usdc and report.json, and points.las if `las` is given."""
