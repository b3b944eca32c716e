"""relit bench: the speed table, measured here and now."""

import typer

from service.cli.bar import Bar
from service.cli.request_commands import local_command
from service.requests.demo import BenchRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "bench", _bench)


def _bench(request: BenchRequest) -> None:
    from service.demo.bench import bench

    with Bar() as bar:
        lines = bench(request.device, request.repeats, bar)
    print("\n".join(lines))
