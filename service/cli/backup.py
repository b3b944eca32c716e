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
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Save the database and the files of the service, which may run meanwhile, with their checksums."""
    from service.server.backup import backup as run

    settings = settings_of(config, data=data)
    made = run(settings, out)
    print(f"backup   {made.folder}")
    print(f"files    {made.files}, {made.size} bytes")
    if settings.storage_url is not None:
        print(f"warning  captures and results are in {settings.storage_url}, and not in the backup: keep versions of its objects")


def restore(
    folder: Annotated[Path, typer.Argument(metavar="BACKUP", help="Folder that relit backup made.")],
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Make a service from a backup, in a new data folder (--data) and an empty database; jobs that ran go on when it starts."""
    from service.server.backup import restore as run

    settings = settings_of(config, data=data)
    made = run(settings, folder)
    print(f"data     {settings.data}")
    print(f"files    {made.files}, {made.size} bytes, as their checksums say")
