"""Steps of the jobs that make no maps: bases, scans and patterns to project."""

from collections.abc import Callable
from pathlib import Path

from service.reporting.progress import Progress
from service.requests.basis import BasisKind
from service.requests.job import JobRequest
from service.requests.jobs import BasisJob, PatternsJob, ScanJob

BASIS = "basis"
"""Name of the file of a basis, without its suffix."""
Intake = Callable[[str], Path]
"""Returns the folder of a capture, checked."""


def can_run(request: JobRequest) -> bool:
    """Return whether a job is one of these kinds."""
    return isinstance(request, BasisJob | ScanJob | PatternsJob)


def run(request: JobRequest, out: Path, intake: Intake, *, device: str, cache: Path, progress: Progress) -> None:
    """Do a job of one of these kinds.

    Args:
        request: of the job.
        out: folder of the results.
        intake: returns the folder of a capture of the job's project.
        device: of the worker.
        cache: folder of the image stacks, one for each capture.
        progress: of the step.
    """
    if isinstance(request, BasisJob):
        _basis(request, out, intake, device, cache, progress)
    elif isinstance(request, ScanJob):
        _scan(request, out, intake, device, progress)
    else:
        assert isinstance(request, PatternsJob), request
        _patterns(request, out, progress)


def _basis(request: BasisJob, out: Path, intake: Intake, device: str, cache: Path, progress: Progress) -> None:
    from service.basis.basis import SUFFIXES, make_basis
    from service.requests.basis import BasisRequest

    kind = BasisKind(request.options.basis)
    options = {name: value for name, value in dict(request.options).items() if name != "basis"}
    make_basis(BasisRequest(capture=intake(request.capture), out=out / f"{BASIS}{SUFFIXES[kind]}", kind=kind, device=device,
                            cache=cache / request.capture, **options), progress)


def _scan(request: ScanJob, out: Path, intake: Intake, device: str, progress: Progress) -> None:
    from service.depth.scan import scan
    from service.requests.scan import ScanRequest

    scan(ScanRequest(scan=intake(request.capture), out=out, device=device, **dict(request.options)), progress)


def _patterns(request: PatternsJob, out: Path, progress: Progress) -> None:
    from service.depth.projection import make_patterns
    from service.requests.patterns import PatternsRequest

    given = request.options.model_dump(exclude_defaults=True)  # options of other codes are refused if they are given
    make_patterns(PatternsRequest(out=out, **given), progress)
