"""relit serve and relit worker: run the service, or a worker on another machine."""

from pathlib import Path
from typing import Annotated, Any

import typer

from service.server.garbage import spared

ConfigOption = Annotated[Path | None, typer.Option(
    "--config", metavar="FILE.toml", show_default=False,
    help="File of settings, which docs/service.md lists. A variable RELIT_… of the environment overrides it.")]
DataOption = Annotated[Path | None, typer.Option("--data", metavar="DIR", show_default=False,
                                                 help="Folder of the service; without it RELIT_DATA, else ./relit-data.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("serve")(serve)
    app.command("worker")(worker)


def serve(
    data: DataOption = None,
    config: ConfigOption = None,
    host: Annotated[str | None, typer.Option("--host", help="Address to listen on.", show_default=False)] = None,
    port: Annotated[int | None, typer.Option("--port", help="Port to listen on; 0 takes a free one.", show_default=False)] = None,
    anonymous: Annotated[bool | None, typer.Option(
        "--anonymous/--keys-only", show_default=False, help="Accept requests without a key; only on loopback addresses.")] = None,
    device: Annotated[list[str] | None, typer.Option(
        "--device", help="Start a worker on this device; may be repeated; none: no worker. Without it one on every GPU, else on the CPU.",
        show_default=False)] = None,
) -> None:
    """Run the service: the API, and a worker on each device."""
    from service.server.malloc import restart_without_thread_caches

    restart_without_thread_caches()  # before the service is imported, which takes a second
    with spared():
        from service.server.serve import serve as run

    run(settings_of(config, data=data, host=host, port=port, anonymous=anonymous, devices=tuple(device) if device else None))


def worker(
    device: Annotated[str | None, typer.Option(
        "--device", help="cpu, cuda:1, …; without it the first CUDA device, else the CPU.", show_default=False)] = None,
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Run one more worker, on any machine that reaches the database and the storage."""
    with spared():
        from service.server.work import work as run

    run(settings_of(config, data=data), device)


def settings_of(config: Path | None, **given: Any) -> Any:
    """Return the settings, with what was given on the command line."""
    from service.server.settings import Settings

    return Settings(config=config, **{name: value for name, value in given.items() if value is not None})  # type: ignore[call-arg]
