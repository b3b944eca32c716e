"""relit backup and relit restore: save a service while it runs, and make one from what was saved."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.server import ConfigOption, DataOption, settings_of


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("backup")(backup)
    app.command("restore")(restore)


def backup(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="New folder for the backup.")],
    objects: Annotated[bool, typer.Option("--objects", help="Copy the objects of storage_url too; else the backup names them.")] = False,
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Save the database and the files of the service, which may run meanwhile, with their checksums."""
    from service.server.backup import backup as run

    settings = settings_of(config, data=data)
    made = run(settings, out, copy_objects=objects)
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
    from service.server.backup import restore as run

    settings = settings_of(config, data=data)
    made = run(settings, folder, accept_differences=accept_differences)
    print(f"data     {settings.data}")
    print(f"files    {made.files}, {made.size} bytes, as their checksums say")
    if made.objects:
        others = "none missing or changed" if not made.differing else (
            f"{made.differing} sent to the store" if made.copied else f"{made.differing} missing or changed")
        print(f"objects  {made.objects} in {settings.storage_url}, {others}")
