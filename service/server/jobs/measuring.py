"""Steps of the jobs that make no maps: bases, parts of the light, scans and patterns to project."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from service.reporting.progress import Progress
from service.requests.basis import BasisKind
from service.requests.job import JobRequest
from service.requests.jobs import BasisJob, PatternsJob, ScanJob, SeparateJob

BASIS = "basis"
"""Name of the file of a basis, without its suffix."""


class Measurement(NamedTuple):
    """What the one step of a job that measures is given."""

    out: Path
    """Folder of the results."""
    intake: Callable[[str], Path]
    """Returns the folder of a capture of the job's project, checked."""
    device: str
    cache: Path
    """Folder of the image stacks, one for each capture."""
    progress: Progress

    def intakes(self, identifiers: Iterable[str]) -> tuple[Path, ...]:
        """Return the folders of several captures."""
        return tuple(map(self.intake, identifiers))


Measure = Callable[[Any, Measurement], None]
"""Does a job of one kind, of which it is given the request."""


def _basis(request: BasisJob, given: Measurement) -> None:
    from service.basis.basis import SUFFIXES, make_basis
    from service.requests.basis import BasisRequest

    kind = BasisKind(request.options.basis)
    options = {name: value for name, value in dict(request.options).items() if name != "basis"}
    make_basis(BasisRequest(capture=given.intake(request.capture), out=given.out / f"{BASIS}{SUFFIXES[kind]}", kind=kind,
                            device=given.device, cache=given.cache / request.capture, **options), given.progress)


def _separate(request: SeparateJob, given: Measurement) -> None:
    from service.depth.separate import separate
    from service.requests.separate import SeparateRequest

    separate(SeparateRequest(capture=given.intake(request.capture), out=given.out, device=given.device,
                             cache=given.cache / request.capture, **dict(request.options)), given.progress)


def _scan(request: ScanJob, given: Measurement) -> None:
    from service.depth.scan import scan
    from service.requests.scan import ScanRequest

    scan(ScanRequest(scan=given.intake(request.capture), out=given.out, device=given.device, **dict(request.options)), given.progress)


def _patterns(request: PatternsJob, given: Measurement) -> None:
    from service.depth.projection import make_patterns
    from service.requests.patterns import PatternsRequest

    options = request.options.model_dump(exclude_defaults=True)  # options of other codes are refused if they are given
    make_patterns(PatternsRequest(out=given.out, **options), given.progress)


MEASURES: dict[type[JobRequest], Measure] = {BasisJob: _basis, SeparateJob: _separate, ScanJob: _scan, PatternsJob: _patterns}
"""What does the jobs of each of these kinds."""
