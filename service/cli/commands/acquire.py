"""relit capture: a capture taken on the set."""

import sys

import typer

from service.cli.progress import ProgressBar
from service.cli.request_commands import local_command
from service.requests.acquire import AcquireRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "capture", _capture)


def _capture(request: AcquireRequest) -> None:
    from service.acquisition.acquire import acquire, refuse_to_ask

    with ProgressBar() as bar:
        result = acquire(request, _ask if sys.stdin.isatty() else refuse_to_ask, _tell, bar)
    for fault in result.retaken:
        print(f"retaken  {fault.shot}: {fault.kind.replace('_', ' ')}: {fault.sentence}")
    for fault in result.faults:
        print(f"fault    {fault.shot}: {fault.kind.replace('_', ' ')}: {fault.sentence}")
    print(f"capture  {result.path}")
    print(f"pictures {result.there} of {result.shots}, {result.taken} taken now; the lamps are dark")
    if result.there < result.shots:
        print("ended    before the last picture: run the same command again to go on")
    if result.faults or result.there < result.shots:
        raise typer.Exit(1)


def _ask(what: str) -> None:
    print(f"please   {what}, then press Enter", file=sys.stderr, flush=True)
    sys.stdin.readline()


def _tell(what: str) -> None:
    print(f"please   {what}", file=sys.stderr, flush=True)
