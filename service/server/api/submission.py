"""Submission of jobs: the captures and environments must be ready, and the job within the limits."""

from collections.abc import Sequence

import sqlalchemy as sa

from service.requests import jobs as asked
from service.requests import states
from service.requests.base.base import JobRequest, SequenceOptions
from service.requests.calibration_jobs import TofCalibrationJob
from service.requests.drive import RigDocument
from service.requests.export import TIME_SAMPLED, AssetFormat
from service.requests.light.frame_range import frame_numbers
from service.requests.relight import RelightOptions
from service.server.api.context import Service
from service.server.api.problems import ApiError
from service.server.base import telemetry
from service.server.database import audit, intakes, jobs, quotas
from service.server.database.jobs import SEQUENCE
from service.server.database.keys import Caller

QUEUE_RETRY_S = 30
SOLVES = ("solve", "pipeline")
"""Kinds of jobs that solve maps."""
OF_RESULTS: dict[str, tuple[str, ...]] = {
    "depth": ("depth",), "depths": ("depth",), "solves": (*SOLVES, "join"), "registered": ("register",), "golden": ("inspect-board",)}
"""The kinds of jobs whose results a field of a job names; those of `maps` depend on the job."""
OF_SEQUENCES = (asked.SolveJob, asked.DepthJob, asked.PipelineJob, asked.RelightJob, asked.ViewJob, TofCalibrationJob)
"""Jobs whose capture may be a sequence of captures."""
KINDS_OF_SEQUENCES = [kind for kind, job in asked.JOBS.items() if issubclass(job, OF_SEQUENCES)]


def submit(service: Service, caller: Caller, request: JobRequest, connection: sa.Connection, inputs: list[str]) -> str:
    """Queue a job in the caller's transaction; `request` is that of `spelled_out`, `inputs` those of `inputs_of`."""
    job = service.queue.submit(connection, project=caller.project, key=caller.key, request=request, inputs=inputs,
                              chunk_frames=service.settings.chunk_frames, trace=telemetry.current())
    require_queue(service, caller, connection)
    if not isinstance(request, asked.CheckJob):  # of which there is one for each capture
        quotas.require(connection, service.settings, quotas.JOBS, caller.project, 0)  # it is counted already
        quotas.require(connection, service.settings, quotas.BYTES, caller.project, 0)
    audit.record(connection, caller, "job.submit", job)
    return job


def require_queue(service: Service, caller: Caller, connection: sa.Connection) -> None:
    """Refuse, and so roll back the transaction, if more than `max_queued` jobs of the caller's key are queued."""
    most = service.settings.max_queued
    if jobs.count_queued(connection, caller.project, caller.key) > most:
        raise ApiError("too-many", f"{most} jobs of this key have not begun", headers={"Retry-After": str(QUEUE_RETRY_S)})


def inputs_of(service: Service, project: str, request: JobRequest) -> list[str]:
    """Return the identifiers of the captures, environments and jobs that a job reads; refuse one that does not exist or is not ready."""
    read = []
    for field in ("capture", "captures", "environment", "reference_ball", "beside", "rig", "apply_to"):
        value = getattr(request, field, None)
        if isinstance(value, RigDocument):  # which comes with the request; the rig of an asset is the identifier of a capture
            continue
        for identifier in value if isinstance(value, tuple) else () if value is None else (value,):
            steps = intakes.time_steps(_require_ready(service, project, field, identifier))
            if steps and not (field == "capture" and isinstance(request, OF_SEQUENCES)):
                raise ApiError("invalid", f"{field}: {identifier} is a sequence of {steps} captures: give one capture here; "
                                          f"{', '.join(KINDS_OF_SEQUENCES)} take sequences")
            if field == "capture" and isinstance(request, asked.SolveJob | asked.DepthJob | asked.PipelineJob):
                _require_sequence(request, steps)
            if isinstance(request, asked.ViewJob):
                _require_step(request, steps)
            read.append(identifier)
    if (maps := getattr(request, "maps", None)) is not None:
        shown = ("depth",) if isinstance(request, asked.ExportJob | asked.ViewJob) else ()
        kinds = SOLVES if isinstance(request, asked.JoinJob) else (*SOLVES, "join", *shown)
        of_sequences = (request.step is not None if isinstance(request, asked.ViewJob) else
                        isinstance(request, asked.RelightJob | asked.ExportJob))
        row = _require_results(service, project, "maps", maps, kinds, sequences=of_sequences)
        if isinstance(request, asked.ViewJob) and request.step is not None and SEQUENCE not in row["finished_steps"]:
            raise ApiError("invalid", f"maps: {maps} is of one capture, and {request.capture} is a sequence: give a job of it")
        if isinstance(request, asked.ExportJob) and SEQUENCE in row["finished_steps"]:
            _require_format(request.format)
        read.append(maps)
    for field, kinds in OF_RESULTS.items():
        value = getattr(request, field, None) or ()
        for name, identifier in ([(field, value)] if isinstance(value, str) else
                                 [(f"{field}[{number}]", each) for number, each in enumerate(value)]):
            row = _require_results(service, project, name, identifier, kinds)
            read.append(identifier)
            if isinstance(request, asked.FuseJob):
                read += inputs_of(service, project, asked.RegisterJob.model_validate(row["request"]))
    if isinstance(request, asked.GaugeBoardJob):
        read += _require_inspections(service, project, request)
    return read


def _require_sequence(request: asked.SolveJob | asked.DepthJob | asked.PipelineJob, steps: int) -> None:
    """Refuse options of sequences for one capture, and assets that cannot hold the steps of a sequence."""
    if not steps and request.sequence != SequenceOptions():
        raise ApiError("invalid", f"sequence: {request.capture} is one capture, and the options are for a sequence of them: leave them out")
    if steps and isinstance(request, asked.PipelineJob):
        _require_format(request.format)


def _require_step(request: asked.ViewJob, steps: int) -> None:
    """Refuse a view of a sequence that names none of its time steps, and one of a capture that names one."""
    if not steps and request.step is not None:
        raise ApiError("invalid", f"step: {request.capture} is one capture, and no sequence: leave the step out")
    if steps and (request.step is None or request.step > steps):
        raise ApiError("invalid", f"step: {request.capture} is a sequence of {steps} captures: give the number of one, 1 to {steps}")


def _require_format(given: AssetFormat) -> None:
    if given not in TIME_SAMPLED:
        raise ApiError("invalid", f"format: is {given}, the asset of a sequence is one of {', '.join(TIME_SAMPLED)}")


def spelled_out(service: Service, project: str, request: JobRequest) -> JobRequest:
    """Return the request with a range of frames in numbers, so that its steps are known before the capture is opened."""
    if isinstance(request, asked.RelightJob):
        if request.environment is None and request.keys is None:
            raise ApiError("invalid", "nothing lights the frames: give an environment, or keys with lights or captured images")
        return request.model_copy(update={"options": _with_frames(service, project, request.capture, request.options)})
    if isinstance(request, asked.DriveJob):
        if request.environment is None and (request.keys is None or not request.keys.lights):
            raise ApiError("invalid", "nothing lights the frames: give an environment, or keys with lights")
        _require_frames(service, request.options.frames, frame_numbers(request.options.frames, 1))
    if isinstance(request, asked.PipelineJob) and (request.environment is not None or request.keys is not None):
        return request.model_copy(update={"relight": _with_frames(service, project, request.capture, request.relight)})
    return request


def _with_frames(service: Service, project: str, capture: str, options: RelightOptions) -> RelightOptions:
    row = intakes.find(service.database, capture, project)
    steps = int((row["facts"] or {}).get("captures", 1)) if row is not None else 1
    numbers = frame_numbers(options.frames, steps)
    _require_frames(service, options.frames, numbers)
    return options.model_copy(update={"frames": f"{numbers[0]}-{numbers[-1]}"})


def _require_frames(service: Service, given: str | None, numbers: Sequence[int]) -> None:
    if len(numbers) > service.settings.max_frames:
        raise ApiError("invalid", f"frames {given}: {len(numbers)} frames, {service.settings.max_frames} are allowed in a job")


def _require_ready(service: Service, project: str, field: str, identifier: str) -> sa.RowMapping:
    row = intakes.find(service.database, identifier, project)
    if row is None:
        raise ApiError("not-found", f"{field}: {identifier} is not in this project")
    if row["state"] != states.READY:
        raise ApiError("conflict", f"{field}: {identifier} is {row['state']}, not ready")
    return row


def _require_inspections(service: Service, project: str, request: asked.GaugeBoardJob) -> list[str]:
    """Return the identifiers of the jobs that inspected the boards of a study, or refuse if one of them judged no regions."""
    for number, run in enumerate(request.study.runs):
        field = f"study.runs[{number}].result"
        row = _require_results(service, project, field, run.result, ("inspect-board",))
        if row["request"].get("regions") is None:
            raise ApiError("invalid", f"{field}: {run.result} inspected a board without regions: give golden and regions to the job")
    return [run.result for run in request.study.runs]


def _require_results(service: Service, project: str, field: str, identifier: str, kinds: Sequence[str], *,
                     sequences: bool = False) -> sa.RowMapping:
    """Return a job whose results can be read; `sequences`: also those of a sequence of captures."""
    row = jobs.find(service.database, identifier, project)
    if row is None:
        raise ApiError("not-found", f"{field}: {identifier} is not in this project")
    if row["request"]["kind"] not in kinds:
        raise ApiError("invalid", f"{field}: {identifier} is a {row['request']['kind']} job: give one of {', '.join(kinds)}")
    if row["state"] != states.SUCCEEDED:
        raise ApiError("conflict", f"{field}: {identifier} is {row['state']}, not succeeded")
    if SEQUENCE in row["finished_steps"] and not sequences:
        raise ApiError("invalid", f"{field}: {identifier} is of a sequence: give the job of one capture here; export and relight take "
                                  "sequences")
    return row
