"""What can be asked of `relit scan`: one frozen model."""

from pathlib import Path

from pydantic import Field

from service.requests.base import Request


class ScanRequest(Request):
    """The point cloud of a scan."""

    scan: Path
    """A folder with a scan.json, or the file."""
    out: Path
    """Folder for points.ply, points.usdc, points.las where it is asked for, and report.json."""
    near_m: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Nearer returns are left out."""
    far_m: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Farther returns are left out."""
    las: bool = False
    """Write points.las too (LAS 1.4)."""
