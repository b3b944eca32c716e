"""Jobs of one step: each calls a product with the files of the captures, environments and jobs that its request names."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.reporting.provenance import name_place
from service.requests.base.base import JobRequest
from service.requests.basis import BasisKind
from service.requests.jobs import (
    BasisJob,
    ExportJob,
    GaugeBoardJob,
    InspectBoardJob,
    JoinJob,
    PatternsJob,
    ScanJob,
    SeparateJob,
    ShadeJob,
    ViewJob,
)
from service.server.jobs.calibrating import CALIBRATIONS
from service.server.jobs.places import StepFiles
from service.server.storage import layout
from stage.capture.sequence import read_sequence
from stage.files import write_text

BASIS = "basis"
"""Name of the file of a basis, without its suffix."""
REGIONS_FILE = "regions.json"
"""Name of the file with the regions of a job, which lies beside what they were judged in."""
STUDY_FILE = "study.json"


def export(request: ExportJob, files: StepFiles) -> None:
    """Make an asset of solved maps or a depth."""
    from service.export.export import export as make_asset
    from service.requests.export import ExportRequest

    make_asset(ExportRequest(maps=files.maps(request.maps), out=files.out / f"{layout.ASSET}.{request.format}",
                             rig=None if request.rig is None else files.intake(request.rig),
                             environment=files.environment_image(request.environment), **dict(request.options)), files.progress)


def _join(request: JoinJob, files: StepFiles) -> None:
    from service.joining.join import join
    from service.requests.solve import JoinRequest

    join(JoinRequest(maps=files.maps(request.maps), depth=files.maps(request.depth), out=files.out, device=files.device), files.progress)


def _shade(request: ShadeJob, files: StepFiles) -> None:
    from service.relight.shade import shade
    from service.requests.shade import ShadeRequest

    capture = request.capture
    shade(ShadeRequest(maps=files.maps(request.maps), out=files.out / layout.PICTURE,
                       environment=files.environment_image(request.environment),
                       capture=None if capture is None else files.intake(capture), device=files.device,
                       cache=None if capture is None else files.cache(capture), **dict(request.options)), files.progress)


def _view(request: ViewJob, files: StepFiles) -> None:
    from service.requests.view import ViewRequest
    from service.viewing.view_files import view

    capture, cache = files.intake(request.capture, request.step), files.cache(request.capture)
    maps = None if request.maps is None else files.maps(request.maps)
    if request.step is not None:
        capture = read_sequence(capture).step(request.step, capture).folder
        cache, maps = cache / capture.name, None if maps is None else maps / capture.name
    view(ViewRequest(capture=capture, maps=maps, out=files.out, device=files.device, cache=cache, **dict(request.options)), files.progress)


def _basis(request: BasisJob, files: StepFiles) -> None:
    from service.basis.basis import SUFFIXES, make_basis
    from service.requests.basis import BasisRequest

    kind = BasisKind(request.options.basis)
    options = {name: value for name, value in dict(request.options).items() if name != "basis"}
    make_basis(BasisRequest(capture=files.intake(request.capture), out=files.out / f"{BASIS}{SUFFIXES[kind]}", kind=kind,
                            device=files.device, cache=files.cache(request.capture), **options), files.progress)


def _separate(request: SeparateJob, files: StepFiles) -> None:
    from service.depth.separate import separate
    from service.requests.depth import SeparateRequest

    separate(SeparateRequest(capture=files.intake(request.capture), out=files.out, device=files.device,
                             cache=files.cache(request.capture), **dict(request.options)), files.progress)


def _scan(request: ScanJob, files: StepFiles) -> None:
    from service.depth.scan import scan
    from service.requests.depth import ScanRequest

    scan(ScanRequest(scan=files.intake(request.capture), out=files.out, device=files.device, **dict(request.options)), files.progress)


def _patterns(request: PatternsJob, files: StepFiles) -> None:
    from service.depth.patterns.projection import make_patterns
    from service.requests.patterns import PatternsRequest

    options = request.options.model_dump(exclude_defaults=True)  # options of other codes are refused if they are given
    make_patterns(PatternsRequest(out=files.out, **options), files.progress)


def _inspect_board(request: InspectBoardJob, files: StepFiles) -> None:
    from service.boards.inspect_board import inspect_board
    from service.requests.inspect_board import InspectBoardRequest

    regions = None
    if request.regions is not None:
        regions = files.out / REGIONS_FILE
        write_text(regions, request.regions.model_dump_json(by_alias=True, indent=2) + "\n")
    inspect_board(InspectBoardRequest(board=files.intake(request.capture), out=files.out,
                                      golden=None if request.golden is None else files.maps(request.golden), regions=regions,
                                      device=files.device, cache=files.cache(request.capture), **dict(request.options)), files.progress)


def _gauge_board(request: GaugeBoardJob, files: StepFiles) -> None:
    from service.boards.gauge_board import gauge_board
    from service.requests.inspect_board import GaugeBoardRequest

    with tempfile.TemporaryDirectory(prefix="relit-gauge-") as made:
        folder = Path(made)
        name_place(folder, files.job.id)
        for run in request.study.runs:
            (folder / run.result).symlink_to(files.maps(run.result), target_is_directory=True)
        write_text(folder / STUDY_FILE, request.study.model_dump_json(by_alias=True))
        gauge_board(GaugeBoardRequest(study=folder / STUDY_FILE, out=files.out), files.progress)


MEASURE = "measure"
ONE_STEP: dict[type[JobRequest], tuple[str, Callable[[Any, StepFiles], None]]] = {
    ExportJob: ("export", export), JoinJob: ("join", _join), ShadeJob: ("shade", _shade), ViewJob: ("view", _view),
    InspectBoardJob: ("inspect", _inspect_board), GaugeBoardJob: ("gauge", _gauge_board),
    BasisJob: (MEASURE, _basis), SeparateJob: (MEASURE, _separate), ScanJob: (MEASURE, _scan), PatternsJob: (MEASURE, _patterns),
    **{kind: (MEASURE, calibrate) for kind, calibrate in CALIBRATIONS.items()}}
"""The name of the step of each of these kinds of jobs, and the function that does it."""
