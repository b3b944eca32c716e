"""The stage at this machine, for the page /set: captures are started and watched, with a key of the scope admin where there are keys."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Protocol

from fastapi import APIRouter, Depends, Request, Response

from service.requests.acquire import PlanChoices
from service.server.api.context import require_admin
from service.server.api.problems import ApiError
from stage.model import Line, Strict


class Stage(Protocol):
    """The stage as the page uses it; service.acquisition.remote_control has it."""

    def described(self) -> dict[str, Any]:
        """Return the rig."""

    def open(self, name: str) -> None:
        """Show a capture that was taken before."""

    def start(self, name: str, chosen: PlanChoices, *, preview: bool, retake: Sequence[str]) -> None:
        """Start a capture."""

    def calibrate(self, step: str) -> None:
        """Measure lights or colours by a ball or a chart that was taken."""

    def look(self, on: bool) -> None:
        """Begin or end the live view."""

    def live_picture(self) -> bytes | None:
        """Return the last picture of the live view."""

    def confirm(self) -> None:
        """Tell that a person has done what was asked for."""

    def stop(self) -> None:
        """End the capture."""

    def state(self) -> dict[str, Any]:
        """Return how far the capture is."""

    def file(self, name: str) -> Path | None:
        """Return the path of a result."""

    def picture(self, shot: str, target: Path) -> bool:
        """Write the picture of a shot."""


class Run(PlanChoices):
    """A capture that is to be started."""

    name: Line
    preview: bool = False
    retake: tuple[Line, ...] = ()


class Named(Strict):
    """A capture that is to be shown."""

    name: Line


class Step(Strict):
    """The target by which a capture is to be calibrated: ball or chart."""

    step: Line


class Live(Strict):
    """Whether the live view is to be seen."""

    on: bool


def _stage(request: Request) -> Stage:
    stage: Stage = request.app.state.stage
    return stage


Given = Annotated[Stage, Depends(_stage)]
router = APIRouter(prefix="/set", include_in_schema=False, dependencies=[Depends(require_admin)])


@router.get("/rig")
def rig(stage: Given) -> dict[str, Any]:
    """Return the rig."""
    return stage.described()


@router.get("/state")
def state(stage: Given) -> dict[str, Any]:
    """Return how far the capture is."""
    return stage.state()


@router.post("/run", status_code=204)
def run(stage: Given, given: Run) -> None:
    """Start a capture."""
    stage.start(given.name, given, preview=given.preview, retake=given.retake)


@router.post("/open", status_code=204)
def show(stage: Given, given: Named) -> None:
    """Show a capture that was taken before."""
    stage.open(given.name)


@router.post("/calibrate", status_code=204)
def calibrate(stage: Given, given: Step) -> None:
    """Measure lights or colours by a ball or a chart that was taken."""
    stage.calibrate(given.step)


@router.post("/look", status_code=204)
def look(stage: Given, given: Live) -> None:
    """Begin or end the live view."""
    stage.look(given.on)


@router.get("/live")
def live(stage: Given) -> Response:
    """Return the last picture of the live view as PNG."""
    data = stage.live_picture()
    if data is None:
        raise ApiError("not-found", "there is no live picture yet")
    return _png(data)


@router.post("/confirm", status_code=204)
def confirm(stage: Given) -> None:
    """Go on after a person has done what was asked for."""
    stage.confirm()


@router.post("/stop", status_code=204)
def stop(stage: Given) -> None:
    """End the capture."""
    stage.stop()


@router.get("/files/{name}")
def file(stage: Given, name: str) -> Response:
    """Return a result as PNG."""
    path = stage.file(name)
    if path is None:
        raise ApiError("not-found", f"there is no {name} yet")
    return _png(path.read_bytes())


@router.get("/picture")
def picture(stage: Given, shot: str) -> Response:
    """Return the picture of a shot as PNG."""
    with tempfile.TemporaryDirectory(prefix="relit-set-") as folder:
        path = Path(folder) / "picture.png"
        if not stage.picture(shot, path):
            raise ApiError("not-found", f"there is no picture of {shot} yet")
        return _png(path.read_bytes())


def _png(data: bytes) -> Response:
    return Response(data, media_type="image/png", headers={"Cache-Control": "no-store"})
