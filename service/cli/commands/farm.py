"""relit farm template: jobs for render farms."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.groups import make_group
from service.cli.printing import print_lines
from service.cli.request_commands import Given, command
from service.requests.base.base import Role
from service.requests.relight import CHUNK_FRAMES, RelightRequest
from service.requests.shade import ShadeRequest

if TYPE_CHECKING:
    from service.farm.jobs import Job

OF_ONE_RUN = frozenset({Role.PART, Role.RUN})
"""Roles of the options that a job has no use for: its tasks choose them."""

JobOption = Annotated[Path, typer.Option(
    "--job", metavar="FILE.yaml|DIR", show_default=False,
    help="A template, with its values in FILE.values.yaml beside it; or a folder, as Deadline Cloud takes it.")]
GpuOption = Annotated[bool, typer.Option("--gpu", help="Require workers with a GPU, and work on it.")]
ChunkOption = Annotated[int, typer.Option("--chunk-frames", min=1, help="Frames of a task; may be changed when the job is submitted.")]
TurnsOption = Annotated[int | None, typer.Option(
    "--turns", min=1, show_default=False,
    help="Number of pictures, one task for each, over which the environment turns once around; needs #### in --out for the number.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    farm = make_group("farm", help="Jobs for render farms; docs/farm.md.")
    kinds = make_group("template", help="Write an Open Job Description template whose tasks run relit relight or relit shade, with the "
                                         "options of that command.")
    command(kinds, "relight", relight, without=OF_ONE_RUN)
    command(kinds, "shade", shade, without=OF_ONE_RUN)
    farm.add_typer(kinds)
    app.add_typer(farm)


def relight(given: Given[RelightRequest], job: JobOption, chunk_frames: ChunkOption = CHUNK_FRAMES, gpu: GpuOption = False) -> None:
    """Frames under new light, one task for each chunk of frames; the frames equal those of a single run bit by bit."""
    from service.farm.jobs import relight_job
    from service.relight.plan import make_plan

    request = given.build(out=str(Path(given.values["out"]).absolute()))  # absolute, as in the requests of its tasks
    frames = make_plan(request).frames
    spelled = request.model_copy(update={"frames": f"{frames[0].scheduled.number}-{frames[-1].scheduled.number}"})
    _write(relight_job(spelled, chunk_frames=chunk_frames, gpu=gpu), job)


def shade(request: ShadeRequest, job: JobOption, turns: TurnsOption = None, gpu: GpuOption = False) -> None:
    """A picture of solved maps, or pictures of one turn of the environment, one task for each picture."""
    from service.farm.jobs import shade_job
    from service.relight.shade import check

    check(request)
    _write(shade_job(request, turns=turns, gpu=gpu), job)


def _write(made: "Job", where: Path) -> None:
    from service.farm.jobs import write_job

    written = write_job(made, where)
    print_lines(template=written.template, values=written.values)
    if written.is_bundle:
        print(f"submit   deadline bundle submit {shlex.quote(str(where))}")
    else:
        print(f"run      openjd run {shlex.quote(str(written.template))} -p {shlex.quote(f'file://{written.values}')}")
