"""The stage at this machine, for the page /set: captures are started and watched, by programs of this machine alone."""

import tempfile
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from fastapi import APIRouter, Depends, Request, Response
from pydantic import BaseModel, ConfigDict

from service.server.api.context import require_local
from service.server.api.problems import ApiError


class Stage(Protocol):
    """What the page asks of a stage; service.acquisition.remote_control has it."""

    def described(self) -> dict[str, Any]:
        """Return the rig."""

    def start(self, name: str, plan: str, *, preview: bool, then: str, retake: str | None) -> None:
        """Start a capture."""

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


class Run(BaseModel):
    """A capture that is to be started."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    plan: str
    preview: bool = False
    then: Literal["", "solve", "solve,export"] = ""
    retake: str | None = None


def _stage(request: Request) -> Stage:
    stage: Stage = request.app.state.stage
    return stage


Given = Annotated[Stage, Depends(_stage)]
router = APIRouter(prefix="/set", include_in_schema=False, dependencies=[Depends(require_local)])


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
    stage.start(given.name, given.plan, preview=given.preview, then=given.then, retake=given.retake)


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
    return Response(path.read_bytes(), media_type="image/png", headers={"Cache-Control": "no-store"})


@router.get("/picture")
def picture(stage: Given, shot: str) -> Response:
    """Return the picture of a shot as PNG."""
    with tempfile.TemporaryDirectory(prefix="relit-set-") as folder:
        path = Path(folder) / "picture.png"
        if not stage.picture(shot, path):
            raise ApiError("not-found", f"there is no picture of {shot} yet")
        return Response(path.read_bytes(), media_type="image/png", headers={"Cache-Control": "no-store"})
