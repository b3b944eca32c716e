"""The routes of the page /set, by which captures at this machine are started and watched; who may use them, the service says."""

import tempfile
from pathlib import Path

from fastapi import APIRouter, HTTPException, Response

from service.acquisition.remote_control import RemoteControl
from service.requests.acquire import PlanChoices
from stage.model import Line, Strict


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


def routes_of(stage: RemoteControl) -> APIRouter:
    """Return the routes of a stage; pictures are PNG files."""
    router = APIRouter(prefix="/set", include_in_schema=False)
    router.get("/rig")(stage.described)
    router.get("/state")(stage.state)
    router.post("/confirm", status_code=204)(stage.confirm)
    router.post("/stop", status_code=204)(stage.stop)

    @router.post("/run", status_code=204)
    def run(given: Run) -> None:
        stage.start(given.name, given, preview=given.preview, retake=given.retake)

    @router.post("/open", status_code=204)
    def show(given: Named) -> None:
        stage.open(given.name)

    @router.post("/calibrate", status_code=204)
    def calibrate(given: Step) -> None:
        stage.calibrate(given.step)

    @router.post("/look", status_code=204)
    def look(given: Live) -> None:
        stage.look(given.on)

    @router.get("/live")
    def live() -> Response:
        return _png(stage.live_picture(), "live picture")

    @router.get("/files/{name}")
    def file(name: str) -> Response:
        path = stage.file(name)
        return _png(None if path is None else path.read_bytes(), name)

    @router.get("/picture")
    def picture(shot: str) -> Response:
        with tempfile.TemporaryDirectory(prefix="relit-set-") as folder:
            path = Path(folder) / "picture.png"
            return _png(path.read_bytes() if stage.picture(shot, path) else None, f"picture of {shot}")

    return router


def _png(data: bytes | None, what: str) -> Response:
    if data is None:
        raise HTTPException(404, f"there is no {what} yet")
    return Response(data, media_type="image/png", headers={"Cache-Control": "no-store"})
