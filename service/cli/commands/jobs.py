"""relit jobs: list, show, wait for, cancel, retry and resume the jobs of a service, and fetch their results."""

from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.groups import make_group
from service.cli.remote import CancelOption, KeyOption, ResultsOption, ServerOption, connected, download, wait_for
from service.requests.base.identifiers import DEFAULT_SERVER

if TYPE_CHECKING:
    from service.requests.answers import JobView

JobArgument = Annotated[str, typer.Argument(metavar="JOB", help="Identifier of the job: job_….", show_default=False)]
OutOption = Annotated[Path | None, typer.Option(
    "--out", metavar="DIR", show_default=False, help="Fetch the files into this folder; without it they are listed.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = make_group(help="List the jobs of a service, wait for them, cancel, retry or resume them, and fetch their results.")
    group.command("list")(list_)
    for command in (show, wait):
        group.command(command.__name__)(command)
    for action, words in (("cancel", "Cancel a job"), ("retry", "Queue a failed job again"), ("resume", "Queue a cancelled job again")):
        group.command(action, help=f"{words}; its finished steps are kept.")(_steer(action))
    group.command("results")(results)
    app.add_typer(group, name="jobs")


def list_(server: ServerOption = DEFAULT_SERVER, key: KeyOption = None) -> None:
    """List the jobs of the project, the newest first."""
    with connected(server, key) as client:
        for job in client.jobs.all():
            print(f"{job.id}  {job.state:<9}  {_moment(job.created_at)}  {job.request.kind:<8}  {job.request.name}")


def show(job: JobArgument, server: ServerOption = DEFAULT_SERVER, key: KeyOption = None) -> None:
    """Show a job: its state, its progress, and why it failed."""
    with connected(server, key) as client:
        _print(client.jobs.get(job))


def wait(job: JobArgument, out: ResultsOption = None, cancel_on_interrupt: CancelOption = False, server: ServerOption = DEFAULT_SERVER,
         key: KeyOption = None) -> None:
    """Wait until a job has ended: exit code 0 if it succeeded, else 1."""
    with connected(server, key) as client:
        wait_for(client, job, out=out, cancel_on_interrupt=cancel_on_interrupt)


def _steer(action: str) -> Callable[..., None]:
    def steer(job: JobArgument, server: ServerOption = DEFAULT_SERVER, key: KeyOption = None) -> None:
        with connected(server, key) as client:
            _print(getattr(client.jobs, action)(job))

    return steer


def results(job: JobArgument, out: OutOption = None, server: ServerOption = DEFAULT_SERVER, key: KeyOption = None) -> None:
    """List the results of a job, or fetch them."""
    with connected(server, key) as client:
        if out is not None:
            download(client, job, out)
            return
        for file in client.jobs.results(job):
            print(f"{file.size:>12}  {file.name}")


def _print(job: "JobView") -> None:
    print(f"job         {job.id}")
    print(f"kind        {job.request.kind}{f', {job.request.name}' if job.request.name else ''}")
    print(f"state       {job.state}, attempt {job.attempt}, priority {job.priority}")
    for what, when in (("created", job.created_at), ("started", job.started_at), ("finished", job.finished_at)):
        if when is not None:
            print(f"{what:<11} {_moment(when)}")
    if job.progress is not None:
        left = f", about {job.progress.remaining_s:.0f} s left" if job.progress.remaining_s else ""
        print(f"progress    {job.progress.stage} {job.progress.done} of {job.progress.total}{left}")
    if job.error is not None:
        print(f"error       {job.error}")


def _moment(time: datetime) -> str:
    return f"{time:%Y-%m-%d %H:%M:%S} UTC"
