"""relit import LAYOUT: make a capture of files that are laid out another way, and say how they were understood."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from service.cli.request_commands import local_command
from service.requests.captures import (
    CameraOptions,
    DiligentImport,
    ImageOptions,
    LpImport,
    NearLightsImport,
    OlatImport,
    OpencvGrayImport,
    RelightlabImport,
    Sense,
)

if TYPE_CHECKING:
    from stage.importers.layout import Imported
    from stage.importers.view import Selection, View


def register(app: typer.Typer) -> None:
    """Add the commands."""
    layouts = typer.Typer(name="import", no_args_is_help=True,
                          help="Write a capture.json for files that are laid out another way; docs/captures.md shows each layout.")
    for name, function in (("diligent", _diligent), ("lp", _lp), ("relightlab", _relightlab), ("olat", _olat),
                           ("near-lights", _near_lights), ("opencv-gray", _opencv_gray)):
        local_command(layouts, name, function)
    app.add_typer(layouts)


def _diligent(request: DiligentImport) -> None:
    from stage.importers import diligent

    _print_path(diligent.import_folder(request.source, request.folder))


def _lp(request: LpImport) -> None:
    from stage.importers import lp

    _print_path(lp.import_folder(request.source, request.folder))


def _opencv_gray(request: OpencvGrayImport) -> None:
    from stage.importers import opencv_gray

    _print_path(opencv_gray.import_folder(request.source, request.folder, projector=request.projector, calibration=request.calibration,
                                          unit_m=request.unit_m))


def _olat(request: OlatImport) -> None:
    from stage.importers import olat

    _print(olat.import_folder(
        request.source, request.folder, axes=request.axes, to_light=request.sense is Sense.TO_LIGHT, lights=request.lights,
        variable=request.variable, run=request.lights_in, strengths=request.strengths, selection=_selection(request), view=_view(request),
        color_space=request.color_space))


def _near_lights(request: NearLightsImport) -> None:
    from stage.importers import near_lights

    _print(near_lights.import_folder(
        request.source, request.folder, axes=request.axes, unit_m=request.unit_m, lights=request.lights, camera=request.camera,
        selection=_selection(request), view=_view(request), color_space=request.color_space))


def _relightlab(request: RelightlabImport) -> None:
    from stage.importers import relightlab

    _print(relightlab.import_folder(request.source, request.destination))


def _view(request: CameraOptions) -> "View":
    from stage.importers.view import View

    return View(**{name: getattr(request, name) for name in CameraOptions.model_fields})


def _selection(request: ImageOptions) -> "Selection":
    from stage.importers.view import Selection

    return Selection(images=request.images, mask=request.mask, ambient=request.ambient)


def _print_path(path: Path) -> None:
    print(f"capture  {path}")


def _print(imported: "Imported") -> None:
    """Print where the capture is, and how the files were understood."""
    _print_path(imported.path)
    for name, sentence in imported.facts:
        print(f"{name:<8} {sentence}")
