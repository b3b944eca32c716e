"""relit farm template: jobs for render farms."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli import relight as relight_here
from service.cli import shade as shade_here
from service.cli.service_options import with_parameters

HERE = {"only", "overwrite", "sheet", "report", "progress"}
"""Parameters of the commands that a farm's tasks have no use for, or that the job itself sets."""
CHUNK_FRAMES = 32
"""As many as one product makes (service.light.combine): with fewer the images are read more often."""

JobOption = Annotated[Path, typer.Option(
    "--job", metavar="FILE.yaml|DIR", show_default=False,
    help="A template, with its values in FILE.values.yaml beside it; or a folder, as Deadline Cloud takes it.")]
GpuOption = Annotated[bool, typer.Option("--gpu", help="Tasks go to workers with a GPU alone, and work on it.")]
ChunkOption = Annotated[int, typer.Option("--chunk-frames", min=1, help="Frames of a task; may be changed when the job is submitted.")]
TurnsOption = Annotated[int | None, typer.Option(
    "--turns", min=1, show_default=False,
    help="So many pictures, a task each, in which the environment turns once around; with #### in --out for the number.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    farm = typer.Typer(name="farm", no_args_is_help=True, help="Jobs for render farms; docs/farm.md.")
    kinds = typer.Typer(name="template", no_args_is_help=True,
                        help="Write an Open Job Description template whose tasks are calls of the command; options are as of it.")
    kinds.command("relight")(_command(relight_here.relight, relight))
    kinds.command("shade")(_command(shade_here.shade, shade))
    farm.add_typer(kinds)
    app.add_typer(farm)


def relight(job: JobOption, chunk_frames: ChunkOption = CHUNK_FRAMES, gpu: GpuOption = False, **chosen: Any) -> None:
    """Frames under new light, a task a chunk of them: bit by bit those of one run."""
    from service.farm.job import JobOptions
    from service.farm.relight import relight_job
    from service.light.plan import make_plan
    from service.requests.relight import RelightRequest

    request = RelightRequest.model_validate({**chosen, "out": str(Path(chosen["out"]).absolute())})  # as its tasks are asked
    frames = make_plan(request).frames
    spelled = request.model_copy(update={"frames": f"{frames[0].lighting.number}-{frames[-1].lighting.number}"})
    _write(relight_job(spelled, JobOptions(gpu), chunk_frames), job)


def shade(job: JobOption, turns: TurnsOption = None, gpu: GpuOption = False, **chosen: Any) -> None:
    """A picture of solved maps, or a turn of the environment in pictures, a task each."""
    from service.farm.job import JobOptions
    from service.farm.shade import shade_job
    from service.light.shade import check
    from service.requests.shade import ShadeRequest

    given = {name: value if name not in ("light", "sphere", "rectangle") else value or () for name, value in chosen.items()}
    request = ShadeRequest.model_validate(given)
    check(request)
    _write(shade_job(request, JobOptions(gpu), turns), job)


def _write(made: Any, where: Path) -> None:
    import shlex

    from service.farm.write import write_job

    written = write_job(made, where)
    print(f"template {written.template}")
    print(f"values   {written.values}")
    if written.is_bundle:
        print(f"submit   deadline bundle submit {shlex.quote(str(where))}")
    else:
        print(f"run      openjd run {shlex.quote(str(written.template))} -p {shlex.quote(f'file://{written.values}')}")


def _command(here: Callable[..., None], own: Callable[..., None]) -> Callable[..., None]:
    """A command with the options of the one that does the work here, and its own."""
    theirs = [parameter for name, parameter in inspect.signature(here).parameters.items() if name not in HERE]
    ours = [parameter for parameter in inspect.signature(own).parameters.values() if parameter.kind is not inspect.Parameter.VAR_KEYWORD]

    def run(**given: Any) -> None:
        own(**given)

    return with_parameters(run, own, [*theirs, *ours])
