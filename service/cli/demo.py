"""relit demo, relit bench: the main job on the shipped sample, and the speed table, measured here and now."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.progress import ProgressBar
from service.cli.request_commands import local_command
from service.requests.demo import BenchRequest, DemoRequest

SERVICE = "service"
"""The folder of the demo's service, inside the folder of the demo."""

ServeOption = Annotated[bool, typer.Option("--serve", help="Afterwards run the service with the sample, for this machine only.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "demo", _demo)
    local_command(app, "bench", _bench)


def _demo(request: DemoRequest, serve: ServeOption = False) -> None:
    from service.demo.demo import demo

    with ProgressBar() as bar:
        result = demo(request, bar)
    print(f"maps     {result.solved.maps_path}")
    print(f"report   {result.solved.report_path}")
    print(f"asset    {result.asset}")
    print(f"frames   {result.frames[0]} … {result.frames[-1].name}")
    print(f"picture  {result.preview}")
    if serve:
        open_service(request.out / SERVICE, request.device)


def open_service(data: Path, device: str | None) -> None:
    """Run a service for this machine alone, with the sample in it."""
    from service.cli.server import settings_of
    from service.demo.demo import sample_folder
    from service.server.sample import show_sample
    from service.server.serve import serve

    sample = sample_folder()
    serve(settings_of(None, data=data, host="127.0.0.1", anonymous=True, roots=(sample,), devices=(device,) if device else None),
          before_answering=lambda address, database, queue: show_sample(address, database, queue, sample))


def _bench(request: BenchRequest) -> None:
    from service.demo.bench import bench

    with ProgressBar() as bar:
        lines = bench(request, bar)
    print("\n".join(lines))
