"""relit demo, relit bench: the main job on the shipped sample, and the speed table, measured here and now."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.printing import print_lines
from service.cli.progress import ProgressBar, with_bar
from service.cli.request_commands import local_command, product_command
from service.requests.demo import BenchRequest, DemoRequest, sample_folder

if TYPE_CHECKING:
    from service.demo.demo import DemoResult
    from service.server.process.sample import SampleResults

SERVICE = "service"
"""The folder of the demo's service, inside the folder of the demo."""
VIEWS = ".views"
"""The folder of what the pages show of the sample, inside the folder of the demo."""

ServeOption = Annotated[bool, typer.Option("--serve", help="Afterwards run the service with the sample, for this machine only.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "demo", _demo)
    product_command(app, "bench", BenchRequest, "service.demo.bench:bench", lambda lines: print("\n".join(lines)))


def _demo(request: DemoRequest, serve: ServeOption = False) -> None:
    from service.demo.demo import demo

    result = with_bar(demo, request)
    print_lines(maps=result.solved.maps_path, report=result.solved.report_path, asset=result.asset,
                frames=f"{result.frames[0]} … {result.frames[-1].name}", picture=result.preview)
    if serve:
        open_service(request.out / SERVICE, request.device, result)


def open_service(data: Path, device: str | None, result: "DemoResult | None" = None) -> None:
    """Run a service for this machine alone in the folder `data`, with the sample in it and, if given, the result of the demo."""
    from service.cli.commands.server import settings_of
    from service.server.process.sample import show_sample
    from service.server.process.serve import serve

    sample, made = sample_folder(), None if result is None else _results(result, device)
    serve(settings_of(None, data=data, host="127.0.0.1", anonymous=True, roots=(sample,), devices=(device,) if device else None),
          before_answering=lambda address, database, queue, storage: show_sample(
              address, database, queue, storage, sample, made))


def _results(result: "DemoResult", device: str | None) -> "SampleResults":
    """Return the files of the demo, and of views of the sample, which are made here."""
    from service.requests.captures import ViewRequest
    from service.server.process.sample import SampleResults
    from service.viewing.view_files import view
    from stage.stack.ingest import CACHE_FOLDER

    out = result.preview.parent
    folders = [out / VIEWS / name for name in ("maps", "capture")]
    with ProgressBar() as bar:
        for folder, maps in zip(folders, (out, None), strict=True):
            view(ViewRequest(capture=sample_folder(), maps=maps, out=folder, device=device, cache=out / CACHE_FOLDER), bar)
    return SampleResults([result.solved.maps_path, result.solved.report_path, result.asset, *result.frames],
                         *(sorted(folder.iterdir()) for folder in reversed(folders)))

