"""Steps of the jobs that inspect boards, and that find how well inspections repeat."""

import tempfile
from pathlib import Path

from service.reporting.progress import Progress
from service.reporting.provenance import name_place
from service.requests.jobs import GaugeBoardJob, InspectBoardJob
from service.server.jobs.scan_sets import PlaceOf
from stage.files import write_text

REGIONS_FILE = "regions.json"
"""Name of the file with the regions of a job, which lies beside what they were judged in."""
STUDY_FILE = "study.json"


def inspect(request: InspectBoardJob, board: Path, out: Path, place_of: PlaceOf, device: str, cache: Path, progress: Progress) -> None:
    """Inspect a board.

    Args:
        request: of the job.
        board: folder of its capture.
        out: folder of the results.
        place_of: where the results of the job are that inspected the golden board.
        device: to compute on.
        cache: folder of the image stacks.
        progress: told of every stage.
    """
    from service.boards.inspect_board import inspect_board
    from service.requests.inspect_board import InspectBoardRequest

    regions = None
    if request.regions is not None:
        regions = out / REGIONS_FILE
        write_text(regions, request.regions.model_dump_json(by_alias=True, indent=2) + "\n")
    inspect_board(InspectBoardRequest(board=board, out=out, golden=None if request.golden is None else place_of(request.golden),
                                      regions=regions, device=device, cache=cache, **dict(request.options)), progress)


def gauge(request: GaugeBoardJob, name: str, out: Path, place_of: PlaceOf, progress: Progress) -> None:
    """Find how well inspections of the same boards repeat.

    Args:
        request: names the jobs that inspected them.
        name: identifier of this job.
        out: folder of the results.
        place_of: where the results of these jobs are.
        progress: told of every stage.
    """
    from service.boards.gauge_board import gauge_board
    from service.requests.gauge_board import GaugeBoardRequest

    with tempfile.TemporaryDirectory(prefix="relit-gauge-") as made:
        folder = Path(made)
        name_place(folder, name)
        for run in request.study.runs:
            (folder / run.result).symlink_to(place_of(run.result), target_is_directory=True)
        study = folder / STUDY_FILE
        write_text(study, request.study.model_dump_json(by_alias=True))
        gauge_board(GaugeBoardRequest(study=study, out=out), progress)
