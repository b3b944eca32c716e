"""relit capture: a capture taken on the set."""

import math
import select
import shlex
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

import typer

from service.cli.printing import counted, print_warnings
from service.cli.progress import ProgressBar, with_bar
from service.cli.request_commands import local_command
from service.errors import USER_ERRORS, sentence
from service.requests.acquire import AcquireRequest, Then
from service.requests.export import ExportRequest
from service.requests.solve import SolveRequest

MAPS, ASSET = "maps", "asset.usdz"
"""Where the results of --then lie in the capture."""
POLL_S = 0.1
"""The longest time until Ctrl-C ends the wait for a person."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "capture", _capture)


def _capture(request: AcquireRequest) -> None:
    from service.acquisition.acquire import Acquisition, refuse_to_ask
    from service.acquisition.early_ingest import EarlyIngest

    stop = threading.Event()
    ask = partial(_ask, stop) if sys.stdin.isatty() else refuse_to_ask
    if request.preview:
        _meter(request, ask)
        return
    with ProgressBar() as bar:
        sender = None
        if request.to is not None:
            from service.cli.sending import Sender

            sender = Sender(request.to, request.out)
        acquisition = Acquisition(request, ask, _tell, bar)
        early = EarlyIngest(request.out, acquisition.shots)
        try:
            result = acquisition.run(stop, [early] if sender is None else [sender, early])
            if result.taken and result.there == result.shots:
                with suppress(*USER_ERRORS):  # the preview meets them again, and says so
                    early.finish()
        finally:
            early.stop()
    for fault in result.retaken:
        print(f"retaken  {fault.shot}: {fault.kind.replace('_', ' ')}: {fault.sentence}")
    for fault in result.faults:
        print(f"fault    {fault.shot}: {fault.kind.replace('_', ' ')}: {fault.sentence}")
    if (response := acquisition.patterns.response) is not None:
        print(f"response that of the projector is near a gamma of {response.gamma:.2f}; patterns are shown in linear light")
    print(f"capture  {result.path}")
    print(f"pictures {result.there} of {result.shots}, {result.taken} taken now; the lamps are dark")
    if result.there < result.shots:
        print("ended    before the last picture: run the same command again to go on")
    else:
        _preview(request, result.taken)
        if sender is not None:
            print(f"sent     {sender.finish()}, at {request.to}", flush=True)
        if request.then and not result.faults:
            _follow(request)
        elif request.then:
            print(f"then     not done, because of the faults; if they do no harm: {_commands(request, request.then)}")
    if result.faults or result.there < result.shots:
        raise typer.Exit(1)


def _meter(request: AcquireRequest, ask: Callable[[str], None]) -> None:
    from service.acquisition.cameras.camera import LIVE, SPOOL
    from service.acquisition.live_view import LivePage
    from service.acquisition.meter import SHARE, meter

    if request.live and request.rig is not None and sys.stdin.isatty() and request.camera.partition(":")[0] in LIVE:
        with LivePage(request.rig, request.camera, request.out / SPOOL) as page:
            if (refused := page.wait()) is None:
                ask(f"open {page.address} in a browser, and frame and focus the object; to meter the light")
            else:
                print(f"live     none: {refused}")
    with ProgressBar() as bar:
        found = meter(request, ask, bar)
    for reading in found.readings:
        print(f"lamp     {reading.lamp}: {100 * reading.clipped:.2g} % of the object clipped, {100 * (1 - SHARE):g} % of it below "
              f"{100 * reading.bright:.3g} % of full scale, focus {reading.focus:.3g}")
    proposed = f"{found.factor:.3g} times the present exposure ({math.log2(found.factor):+.2g} stops)"
    if not found.sure:
        print(f"exposure {proposed} or less, since {found.brightest.lamp} clips: set it, and meter again")
    elif found.exposure_s is None:
        print(f"exposure {proposed}")
    else:
        held = "" if found.clipped is None else f": {100 * found.clipped:.2g} % of the object clip under {found.brightest.lamp}"
        print(f"exposure {found.exposure_s:.4g} s, {proposed}{held}")
    print(f"meter    {found.path}, {found.picture}; the lamps are dark")


def _preview(request: AcquireRequest, taken: int) -> None:
    """Write the preview, unless there is one of the same pictures and no view is asked for; a capture without one is as good as others."""
    from service.acquisition.early_ingest import PREVIEW_FILE, write_preview
    from service.relight.sheet import AS_EVER

    if taken == 0 and request.review == AS_EVER and (request.out / PREVIEW_FILE).exists():
        return
    try:
        made = write_preview(request.out, request.device, review=request.review)
        print(f"preview  {made.path}", flush=True)
        print_warnings(made.warnings)
    except USER_ERRORS as error:
        print(f"preview  none: {sentence(error)}", flush=True)


def _follow(request: AcquireRequest) -> None:
    """Do what is to be done with the capture; where that fails, say how to go on without the stage."""
    from service.export.export import export
    from service.solve.solve import solve

    left = list(request.then)
    try:
        while left:
            if left[0] is Then.SOLVE:
                solved = with_bar(solve, SolveRequest(capture=request.out, out=request.out / MAPS, device=request.device))
                print(f"maps     {solved.maps_path}", flush=True)
                print(f"pixels   {counted(solved.counts)}")
                print_warnings(solved.warnings)
            else:
                exported = with_bar(export, ExportRequest(maps=request.out / MAPS, out=request.out / ASSET))
                print(f"asset    {exported.path}")
                print_warnings(exported.warnings)
            left.pop(0)
    except BaseException:
        print(f"go on    the capture is whole: {_commands(request, left)}", file=sys.stderr, flush=True)
        raise


def _commands(request: AcquireRequest, steps: Sequence[Then]) -> str:
    maps = request.out / MAPS
    words = {Then.SOLVE: ["relit", "solve", request.out, "--out", maps],
             Then.EXPORT: ["relit", "export", maps, "--out", request.out / ASSET]}
    return " && ".join(shlex.join(map(str, words[step])) for step in steps)


def _ask(stop: threading.Event, what: str) -> None:
    from service.acquisition.lights.lights import THEN_ENTER

    _tell(f"{what}{THEN_ENTER}")
    while not stop.is_set():
        if select.select([sys.stdin], [], [], POLL_S)[0]:
            sys.stdin.readline()
            return


def _tell(what: str) -> None:
    from service.acquisition.lights.lights import PLEASE

    print(f"{PLEASE}{what}", file=sys.stderr, flush=True)
