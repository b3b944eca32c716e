"""What `relit scan` takes."""

from pathlib import Path
from typing import Annotated

from service.requests.base import DeviceRequest, Role, Spelling
from stage.model import Positive


class ScanRequest(DeviceRequest):
    """Shots of a scanning laser, from a platform that may move, as one point cloud."""

    scan: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SCAN")]
    """A folder with a scan.json, or the file."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for points.ply, points.usdc, points.las where it is asked for, and report.json."""
    near_m: Positive | None = None
    """Nearer returns, in metres, are left out."""
    far_m: Positive | None = None
    """Farther returns, in metres, are left out."""
    las: bool = False
    """Write points.las (LAS 1.4) too; needs laspy: pip install 'relit[las]'."""
