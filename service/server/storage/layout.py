"""The layout of the storage: where files lie below the data folder or the prefix of an object store (docs/service_storage.md).

projects/PROJECT/captures/ID/…        an uploaded capture
projects/PROJECT/environments/ID/…    an uploaded environment, one image
projects/PROJECT/jobs/ID/…            results: maps.exr, report.json, asset.usdz, frame.0001.exr …
projects/PROJECT/shared/ID/…          of a job that runs: pieces of its solve that are done, and who makes which frames
uploads/ID/…                          in an object store: pieces of incomplete uploads
"""

from collections.abc import Container

from service.requests.base.identifiers import CAPTURE, ENVIRONMENT

MAPS = "maps.exr"
SOLVED = (MAPS, "depth.exr", "points.ply", "report.json", "sequence.json", "scan-set.json", "board.exr")
"""Files of a solve, a depth, a registration or an inspection that other jobs and later steps read."""
FRAMES = "frame.####.exr"
PICTURE = "picture.exr"
ASSET = "asset"
PIECES = "uploads"
"""Prefix of the pieces of incomplete uploads, in an object store."""
FOLDERS = {CAPTURE: "captures", ENVIRONMENT: "environments"}


def intake(project: str, identifier: str) -> str:
    """Return the prefix of a capture or an environment."""
    return f"projects/{project}/{FOLDERS[identifier.partition('_')[0]]}/{identifier}"


def pieces(upload: str) -> str:
    """Return the prefix of the pieces of an incomplete upload."""
    return f"{PIECES}/{upload}"


def results(project: str, job: str) -> str:
    """Return the prefix of the results of a job."""
    return f"projects/{project}/jobs/{job}"


def shared(project: str, job: str) -> str:
    """Return the prefix of what the workers of a running job have done so far; it is deleted when the job ends."""
    return f"projects/{project}/shared/{job}"


def is_shared(path: str) -> bool:
    """Return whether a path is below a prefix of `shared`."""
    return path.split("/")[2:3] == ["shared"]


def is_of_job(path: str, jobs: Container[str]) -> bool:
    """Return whether a path is below the results of one of these jobs."""
    parts = path.split("/")
    return parts[2:3] == ["jobs"] and parts[3:4] != [] and parts[3] in jobs
