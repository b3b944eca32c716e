"""relit keys: who may use the service."""

from typing import Annotated, Any

import typer

from service.cli.printing import print_table
from service.cli.request_commands import command
from service.cli.server import ConfigOption, DataOption, settings_of
from service.requests.keys import NewKey


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(name="keys", no_args_is_help=True, help="Make, list and revoke the keys of the service.")
    command(group, "create", _create)
    group.command("list")(list_)
    group.command("revoke")(revoke)
    app.add_typer(group)


def _create(wanted: NewKey, data: DataOption = None, config: ConfigOption = None) -> None:
    import sys

    from service.server.database import keys
    from service.server.database.engine import open_database
    from service.server.database.schema import upgrade
    from service.server.permissions import keep_private

    def prepare(settings: Any, database: Any) -> None:
        keep_private()
        settings.data.mkdir(parents=True, exist_ok=True)
        upgrade(database)

    print(keys.create(open_database(settings_of(config, data=data), prepare), wanted))
    print("keep it: it is not shown again", file=sys.stderr)


def list_(
    project: Annotated[str | None, typer.Option("--project", help="List only the keys of this project.", show_default=False)] = None,
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Show the keys that were made, without their secrets."""
    from datetime import UTC, datetime

    from service.server.database import keys

    def day(seconds: float) -> str:
        return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M")

    rows = [("KEY", "PROJECT", "SCOPE", "CREATED (UTC)", "REVOKED", "NAME")]
    rows += [(row["id"], row["project"], row["scope"], day(row["created_at"]), "" if row["revoked_at"] is None else day(row["revoked_at"]),
              row["name"]) for row in keys.listing(_open(settings_of(config, data=data)), project)]
    print_table(rows)


def revoke(
    key: Annotated[str, typer.Argument(metavar="KEY_ID", help="Identifier of the key, as relit keys list shows it.")],
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Revoke a key: requests with it are refused from now on."""
    from service.errors import RequestError
    from service.server.database import keys

    if not keys.revoke(_open(settings_of(config, data=data)), key.partition(".")[0]):
        raise RequestError(f"{key.partition('.')[0]}: there is no such key that is not revoked")
    print(f"revoked  {key.partition('.')[0]}")


def _open(settings: Any) -> Any:
    """Open the database of an existing service; a wrong --data makes no new one."""
    from service.errors import RequestError
    from service.server.database.engine import open_database
    from service.server.database.schema import require_current

    if settings.is_sqlite and not settings.sqlite_file.exists():
        raise RequestError(f"data {settings.data}: there is no service in this folder")
    return open_database(settings, lambda _settings, database: require_current(database))
