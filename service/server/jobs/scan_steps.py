"""Steps on many scans, of which several workers do pieces: registration and fusion."""

from service.reporting.progress import Progress
from service.requests.jobs import FuseJob, RegisterJob
from service.server.jobs import scan_sets
from service.server.jobs.context import Job, JobStep, WorkerContext
from service.server.jobs.pieces import JobPieces
from service.server.jobs.places import job_maps, results_folder


def step_of(job: Job, request: RegisterJob | FuseJob, context: WorkerContext) -> JobStep:
    """Return the step of a job."""
    def run(progress: Progress, *, leads: bool) -> None:
        from service.scans.pieces import SharedPieces

        pieces = JobPieces(context, job)
        sharing = SharedPieces(pieces, leads=leads, invite=pieces.invite) if leads else SharedPieces(pieces, leads=False)
        out = results_folder(job, context)
        if isinstance(request, RegisterJob):
            do = scan_sets.register if leads else scan_sets.help_register
            do(request, job.id, out, lambda other: job_maps(job, other, context, progress), progress, sharing)
        else:
            fuse = scan_sets.fuse if leads else scan_sets.help_fuse
            fuse(request, out, lambda other: job_maps(job, other, context, progress), context.device, progress, sharing)
        if leads:
            pieces.remove()

    return JobStep(request.kind, lambda progress: run(progress, leads=True), help=lambda progress: run(progress, leads=False))
