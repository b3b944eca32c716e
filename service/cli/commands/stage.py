"""relit play and twin: cues sent to the lamps of a rig, and a stage that is not there, to rehearse on."""

import typer

from service.cli.printing import print_warnings
from service.cli.progress import ProgressBar
from service.cli.request_commands import local_command
from service.requests.play import PlayRequest, TwinRequest


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "play", _play)
    local_command(app, "twin", _twin)


def _play(request: PlayRequest) -> None:
    from service.play.play import LATE_S, play

    result = play(request)
    print(f"frames   {result.frames} sent; the lamps are dark")
    late = "none" if not result.late else f"{result.late} by more than {1e3 * LATE_S:g} ms, the latest by {1e3 * result.latest_s:.3g} ms"
    print(f"late     {late}")
    if result.interrupted and not request.loop and request.hold is None:
        print("ended    before the last frame")
        raise typer.Exit(1)


def _twin(request: TwinRequest) -> None:
    from service.twin.twin import open_twin, rehearse

    with ProgressBar() as bar:
        twin = open_twin(request, bar)
    print_warnings(twin.picture.warnings)
    result = rehearse(twin, request, lambda page: _listening(request.interface, page))
    print(f"frames   {result.frames} received")
    if result.out_of_order:
        print(f"packets  {result.out_of_order} came out of order and were left out")
    for name, path in (("picture", request.snapshot), ("levels", request.record)):
        if path is not None:
            print(f"{name:<8} {path}")


def _listening(interface: str, page: str | None) -> None:
    print(f"twin     listens on {interface} for sACN and Art-Net", flush=True)
    if page is not None:
        print(f"page     {page}: until Ctrl-C", flush=True)
