"""relit serve, worker, backup and restore: run the service or a worker, and save a service while it runs."""

from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.progress import ProgressBar

ConfigOption = Annotated[Path | None, typer.Option(
    "--config", metavar="FILE.toml", show_default=False,
    help="File of settings, which docs/service.md lists. A variable RELIT_… of the environment overrides it.")]
DataOption = Annotated[Path | None, typer.Option("--data", metavar="DIR", show_default=False,
                                                 help="Folder of the service; without it RELIT_DATA, else ./relit-data.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("serve")(serve)
    app.command("worker")(worker)
    app.command("backup")(backup)
    app.command("restore")(restore)


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
    rig: Annotated[Path | None, typer.Option(
        "--set", metavar="RIG.json", show_default=False,
        help="Take captures at this machine, with the lamps of a rig, on the page /set, which takes a key of the scope admin.")] = None,
    camera: Annotated[str | None, typer.Option(
        "--camera", help="The camera of --set, as relit capture takes it.", show_default=False)] = None,
    trigger: Annotated[str | None, typer.Option(
        "--trigger", metavar="COMMAND", help="The program that releases the camera of --set, as relit capture takes it.",
        show_default=False)] = None,
    projector: Annotated[str | None, typer.Option(
        "--projector", metavar="WxH", help="Width and height of the projector of --set in pixels, for patterns.",
        show_default=False)] = None,
    projector_port: Annotated[int | None, typer.Option(
        "--projector-port", help="The port of the page of --projector, as relit capture takes it.", show_default=False)] = None,
) -> None:
    """Run the service: the API, and a worker on each device."""
    from service.server.process.serve import serve as run

    settings = settings_of(config, data=data, host=host, port=port, anonymous=anonymous, devices=tuple(device) if device else None)
    if rig is None or camera is None:
        if any(given is not None for given in (rig, camera, trigger, projector, projector_port)):
            from service.errors import RequestError

            raise RequestError("--set and --camera go together, and --trigger and --projector with them: give the lamps and the camera")
        run(settings)
        return
    from service.acquisition.remote_control import RemoteControl
    from service.acquisition.set_routes import routes_of

    stage = RemoteControl(rig, camera, settings.set_captures, trigger=trigger, projector=projector, projector_port=projector_port)
    try:
        run(settings, set_routes=routes_of(stage))
    finally:
        stage.close()


def worker(
    device: Annotated[str | None, typer.Option(
        "--device", help="cpu, cuda:1, …; without it the first CUDA device, else the CPU.", show_default=False)] = None,
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Run one more worker, on any machine that reaches the database and the storage."""
    from service.server.process.processes import work as run

    run(settings_of(config, data=data), device)


def backup(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="New folder for the backup.")],
    objects: Annotated[bool, typer.Option("--objects", help="Copy the objects of storage_url too; else the backup names them.")] = False,
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Save the database and the files of the service, which may run meanwhile, with their checksums."""
    from service.server.process.backup import backup as run

    settings = settings_of(config, data=data)
    with ProgressBar() as bar:
        made = run(settings, out, copy_objects=objects, progress=bar)
    print(f"backup   {made.folder}")
    print(f"files    {made.files}, {made.size} bytes")
    if settings.storage_url is not None:
        print(f"objects  {made.objects} of {settings.storage_url}" + (", copied" if made.copied else
              ", named and not copied: relit restore looks for them there; keep versions of them"))


def restore(
    folder: Annotated[Path, typer.Argument(metavar="BACKUP", help="Folder that relit backup made.")],
    accept_differences: Annotated[bool, typer.Option(
        "--accept-differences", help="Restore although objects of storage_url are missing or have changed since the backup.")] = False,
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Make a service from a backup, in a new data folder (--data) and an empty database; jobs that ran go on when it starts."""
    from service.server.process.backup import restore as run

    settings = settings_of(config, data=data)
    with ProgressBar() as bar:
        made = run(settings, folder, accept_differences=accept_differences, progress=bar)
    print(f"data     {settings.data}")
    print(f"files    {made.files}, {made.size} bytes, as their checksums say")
    if made.objects:
        others = "none missing or changed" if not made.differing else (
            f"{made.differing} sent to the store" if made.copied else f"{made.differing} missing or changed")
        print(f"objects  {made.objects} in {settings.storage_url}, {others}")


def settings_of(config: Path | None, **given: Any) -> Any:
    """Return the settings, with what was given on the command line."""
    from service.server.base.settings import Settings

    return Settings(config=config, **{name: value for name, value in given.items() if value is not None})  # type: ignore[call-arg]
