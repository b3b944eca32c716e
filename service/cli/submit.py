"""relit submit: the work of solve, depth, relight, shade and export, done by a service; and most of it in one job, pipeline."""

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeVar

import typer

from service.cli import depth as depth_here
from service.cli import relight as relight_here
from service.cli import results as results_here
from service.cli import shade as shade_here
from service.cli.service_options import (
    DEFAULT_PRIORITY,
    DEFAULT_SERVER,
    CancelOption,
    KeyOption,
    NameOption,
    PriorityOption,
    ResultsOption,
    ServerOption,
    WaitOption,
    connected,
    options_of,
    with_parameters,
)
from service.cli.waiting import make_folder, wait_for

if TYPE_CHECKING:
    from pydantic import BaseModel

    from service.client import Client
    from service.client.intakes import Intakes
    from service.requests.jobs import JobRequest
    from service.requests.light_keys import LightKeys
    from service.requests.relight import RelightOptions

Chosen = TypeVar("Chosen", bound="BaseModel")
SOURCES = "a folder of this machine, which is uploaded; an identifier such as cap_…; or server:/path, which is registered"
CaptureArgument = Annotated[str, typer.Argument(metavar="CAPTURE", help=f"The capture: {SOURCES}.", show_default=False)]
MapsArgument = Annotated[str, typer.Argument(metavar="JOB", help="The job that made the maps: job_….", show_default=False)]
EnvironmentOption = Annotated[str | None, typer.Option(
    "--environment", metavar="FILE", show_default=False, help="Lat-long .exr or .hdr: a file, env_…, or server:/path, as CAPTURE.")]
KeysOption = Annotated[Path | None, typer.Option("--keys", metavar="FILE", help="Light keys (JSON); docs/relight.md.", show_default=False)]
MapsOption = Annotated[str | None, typer.Option(
    "--maps", metavar="JOB", help="A solve job of the capture: its maps guide the frames.", show_default=False)]
BallOption = Annotated[str | None, typer.Option(
    "--reference-ball", metavar="CAPTURE", show_default=False, help="A ball of the object's material, for --method reference; as CAPTURE.")]
ShadedOption = Annotated[str | None, typer.Option(
    "--capture", metavar="CAPTURE", show_default=False,
    help="The capture of the maps, as elsewhere: its images bring what a model of the maps lacks.")]
TofOption = Annotated[str | None, typer.Option(
    "--tof-calibration", metavar="NAME", show_default=False, help="Name of a relit.tof/1 file in the capture's folder.")]


FormatOption = Annotated[Literal["usdz", "usda", "usdc"], typer.Option("--format", help="Of the asset.")]
GuidedOption = Annotated[bool, typer.Option("--guided", help="Guide the frames by the maps that were solved.")]
REGISTERED = "server:"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(no_args_is_help=True, help="Hand work to a service; what may be chosen is as in the commands that do it here.")
    for function, here in ((solve, [results_here.solve]), (depth, [depth_here.depth]), (relight, [relight_here.relight]),
                           (shade, [shade_here.shade]), (export, [results_here.export]),
                           (pipeline, [results_here.solve, results_here.export, relight_here.relight])):
        group.command(function.__name__)(_command(function, options_of(*here)))
    app.add_typer(group, name="submit")


class Site(NamedTuple):
    """Where a job is handed in, and what is chosen about it."""

    client: "Client"
    job: dict[str, Any]
    """What every job has: name and priority."""
    chosen: dict[str, Any]
    """Options of the work."""

    def options(self, model: "type[Chosen]", **others: Any) -> "Chosen":
        """The options that a model has; the others are its defaults."""
        return model.model_validate({name: value for name, value in (self.chosen | others).items()
                                     if name in model.model_fields and value is not None})

    def capture(self, given: str) -> str:
        """Identifier of a capture that is given in one of the three ways."""
        return _intake(self.client.captures, "capture", given)

    def environment(self, given: str | None) -> str | None:
        """The same of an environment, which may be none."""
        return None if given is None else _intake(self.client.environments, "environment", given)


def solve(site: Site, capture: CaptureArgument, reference_ball: BallOption = None) -> "JobRequest":
    """Normals, albedo and height of a light-stage capture."""
    from service.requests.jobs import SolveJob
    from service.requests.solve import SolveOptions

    return SolveJob(kind="solve", options=site.options(SolveOptions), **site.job, capture=site.capture(capture),
                    reference_ball=None if reference_ball is None else site.capture(reference_ball))


def depth(site: Site, capture: CaptureArgument, tof_calibration: TofOption = None) -> "JobRequest":
    """Depth from projected patterns, a laser or time of flight."""
    from service.requests.depth import DepthOptions, TofChoices
    from service.requests.jobs import DepthJob

    return DepthJob(kind="depth", options=site.options(DepthOptions, tof=site.options(TofChoices)), tof_calibration=tof_calibration,
                    **site.job, capture=site.capture(capture))


def relight(site: Site, capture: CaptureArgument, environment: EnvironmentOption = None, keys: KeysOption = None,
            maps: MapsOption = None) -> "JobRequest":
    """Frames under HDR environments and animated lights."""
    from service.requests.jobs import RelightJob

    return RelightJob(kind="relight", options=_frames(site), keys=_keys(keys), maps=maps, **site.job,
                      capture=site.capture(capture), environment=site.environment(environment))


def shade(site: Site, maps: MapsArgument, environment: EnvironmentOption = None, capture: ShadedOption = None) -> "JobRequest":
    """A picture of solved maps under near lights, area lights and an environment, with cast shadows."""
    from service.requests.jobs import ShadeJob
    from service.requests.shade import ShadeOptions

    return ShadeJob(kind="shade", maps=maps, options=site.options(ShadeOptions), **site.job, environment=site.environment(environment),
                    capture=None if capture is None else site.capture(capture))


def export(site: Site, maps: MapsArgument, format: FormatOption = "usdz") -> "JobRequest":
    """A USD asset: solved maps with the estimated material, a depth with its colours."""
    from service.requests.export import ExportOptions
    from service.requests.jobs import ExportJob

    return ExportJob(kind="export", maps=maps, format=format, options=site.options(ExportOptions), **site.job)


def pipeline(site: Site, capture: CaptureArgument, environment: EnvironmentOption = None, keys: KeysOption = None,
             format: FormatOption = "usdz", guided: GuidedOption = False) -> "JobRequest":
    """Solve, then export, then relight, in one job; without light for frames it ends with the asset."""
    from service.requests.export import ExportOptions
    from service.requests.jobs import PipelineJob
    from service.requests.solve import SolveOptions

    return PipelineJob(kind="pipeline", solve=site.options(SolveOptions), export=site.options(ExportOptions),
                       relight=_frames(site), keys=_keys(keys), format=format, guided=guided, **site.job,
                       capture=site.capture(capture), environment=site.environment(environment))


def _command(function: Callable[..., "JobRequest"], options: list[inspect.Parameter]) -> Callable[..., None]:
    """The command of a function: its own parameters, the options of the work, and those of every job."""
    own = list(inspect.signature(function).parameters.values())[1:]
    chosen = [option for option in options if option.name not in {parameter.name for parameter in own}]

    def run(**given: Any) -> None:
        work = {parameter.name: given.pop(parameter.name) for parameter in own}
        choice = {option.name: given.pop(option.name) for option in chosen}
        _submit(lambda client, job: function(Site(client, job, choice), **work), **given)

    return with_parameters(run, function, [*own, *chosen, *list(inspect.signature(_submit).parameters.values())[1:]])


def _submit(make: Callable[["Client", dict[str, Any]], "JobRequest"], *, server: ServerOption = DEFAULT_SERVER, key: KeyOption = None,
            job_name: NameOption = "", priority: PriorityOption = DEFAULT_PRIORITY, wait: WaitOption = False, out: ResultsOption = None,
            cancel_on_interrupt: CancelOption = False) -> None:
    from service.requests.jobs import JobRequest

    common = dict(JobRequest(name=job_name, priority=priority))
    with connected(server, key) as client:
        if out is not None:
            make_folder(out)  # before hours of waiting
        job = client.jobs.submit(make(client, common))
        print(f"job         {job.id}", flush=True)
        if wait or out is not None:
            wait_for(client, job.id, out=out, cancel_on_interrupt=cancel_on_interrupt)


def _intake(intakes: "Intakes", what: str, given: str) -> str:
    from service.cli.bar import Bar
    from service.requests.identifiers import CAPTURE, ENVIRONMENT, pattern

    path = Path(given)
    if given.startswith(REGISTERED):
        found = intakes.register(given.removeprefix(REGISTERED))
    elif not path.exists() and re.fullmatch(pattern(CAPTURE if what == "capture" else ENVIRONMENT), given):
        return given
    else:
        with Bar() as bar:
            found = intakes.upload(path, progress=bar)
    print(f"{what:<11} {found.id}", flush=True)
    return found.id


def _frames(site: Site) -> "RelightOptions":
    from service.requests.frame_range import frame_numbers
    from service.requests.relight import RelightOptions

    options = site.options(RelightOptions)
    frame_numbers(options.frames, 1)  # what is no range is refused before files are sent
    return options


def _keys(path: Path | None) -> "LightKeys | None":
    from service.requests.light_keys import LightKeys

    return None if path is None else LightKeys.read(path)
