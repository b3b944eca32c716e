"""`relit submit` and `relit jobs` share these options, the client, waiting for a job, and fetching its results."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.printing import tell
from service.cli.progress import ProgressBar

if TYPE_CHECKING:
    from service.client import Client

UNSUCCESSFUL, INTERRUPTED = 1, 130

ServerOption = Annotated[str, typer.Option(
    "--server", metavar="URL", envvar="RELIT_SERVER", help="Address of the service, as relit serve prints it.")]
KeyOption = Annotated[str | None, typer.Option(
    "--key", metavar="KEY", envvar="RELIT_KEY", show_default=False,
    help="Key that relit keys create printed; set it in the environment, as other users of this machine see command lines.")]
WaitOption = Annotated[bool, typer.Option("--wait", help="Wait until the job has ended; the exit code is 0 if it succeeded, else 1.")]
ResultsOption = Annotated[Path | None, typer.Option(
    "--out", metavar="DIR", show_default=False, help="Wait until the job has ended, then fetch its results into this folder.")]
CancelOption = Annotated[bool, typer.Option(
    "--cancel-on-interrupt", help="Cancel the job when Ctrl-C ends the waiting; without it the job goes on.")]


@contextmanager
def connected(server: str, key: str | None) -> "Iterator[Client]":
    """Yield a client whose errors become one sentence and exit code 2."""
    from service.client import Client, ClientError
    from service.errors import RequestError

    try:
        with Client(server, key, on_silence=tell) as client:
            yield client
    except ClientError as error:
        raise RequestError(str(error)) from error


def wait_for(client: "Client", job: str, *, out: Path | None, cancel_on_interrupt: bool) -> None:
    """Wait until a job has ended, and fetch what it made into the folder `out`, if there is one; exit with code 1 if it did not succeed."""
    from service.client import JobEnded

    try:
        with ProgressBar() as bar:
            ended = client.jobs.wait(job, progress=bar)
    except JobEnded as error:
        tell(str(error))
        raise typer.Exit(UNSUCCESSFUL) from error
    except KeyboardInterrupt:
        if cancel_on_interrupt:
            client.jobs.cancel(job)
            tell(f"interrupted; {job} is cancelled")
        else:
            tell(f"interrupted; {job} goes on: relit jobs wait {job} waits again, relit jobs cancel {job} ends it")
        sys.exit(INTERRUPTED)
    if ended.started_at is not None and ended.finished_at is not None:
        print(f"state       {ended.state}, {(ended.finished_at - ended.started_at).total_seconds():.1f} s")
    if out is not None:
        download(client, job, out)
    for sentence in client.jobs.log(job).warnings:
        print(f"warning     {sentence}")


def make_folder(out: Path) -> None:
    """Make the folder for what a job makes."""
    from service.client.local_files import file_errors

    with file_errors(out, "make"):
        out.mkdir(parents=True, exist_ok=True)


def download(client: "Client", job: str, out: Path) -> None:
    """Fetch what a job has made."""
    with ProgressBar() as bar:
        found = client.jobs.download(job, out, progress=bar)
    last = f" … {found[-1].name}" if len(found) > 1 else ""
    print(f"results     {found[0]}{last}" if found else "results     none")
