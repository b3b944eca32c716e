"""relit keys and relit audit: who may use the service, and who did what."""

from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from service.cli.commands.server import ConfigOption, DataOption, settings_of
from service.cli.groups import make_group
from service.cli.printing import print_table
from service.cli.request_commands import command
from service.requests.keys import NewKey

if TYPE_CHECKING:
    from service.server.database.engine import Database

T = TypeVar("T")
ProjectOption = Annotated[str | None, typer.Option("--project", help="List only what belongs to this project.", show_default=False)]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = make_group("keys", help="Make, list and revoke the keys of the service.")
    command(group, "create", _create)
    group.command("list")(list_)
    group.command("revoke")(revoke)
    app.add_typer(group)
    app.command("audit")(audit)


def _create(wanted: NewKey, data: DataOption = None, config: ConfigOption = None) -> None:
    import sys

    from service.server.database import audit, keys
    from service.server.database.engine import connect, usable
    from service.server.database.schema import upgrade

    def work(connection: Any) -> str:
        key = keys.insert(connection, wanted)
        audit.record_operator(connection, wanted.project, "key.create", key.partition(".")[0])
        return key

    settings = settings_of(config, data=data)
    with usable(settings):
        settings.data.mkdir(parents=True, exist_ok=True)
        with closing(connect(settings.sqlalchemy_url)) as database:
            upgrade(database)
            print(database.transact(work))
    print("keep it: it is not shown again", file=sys.stderr)


def list_(project: ProjectOption = None, data: DataOption = None, config: ConfigOption = None) -> None:
    """Show the keys that were made, without their secrets."""
    from service.server.database import keys

    rows = [("KEY", "PROJECT", "SCOPE", "CREATED (UTC)", "LAST USED", "EXPIRES", "REVOKED", "NAME")]
    times = "created_at", "used_at", "expires_at", "revoked_at"
    rows += [(row["id"], row["project"], row["scope"], *(_time(row[name]) for name in times), row["name"])
             for row in _existing(settings_of(config, data=data), lambda database: keys.listing(database, project))]
    print_table(rows)


def revoke(
    key: Annotated[str, typer.Argument(metavar="KEY_ID", help="Identifier of the key, as relit keys list shows it.")],
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Revoke a key: requests with it are refused from now on."""
    from service.errors import RequestError
    from service.server.database import audit, keys

    identifier = key.partition(".")[0]

    def work(connection: Any) -> str | None:
        project = keys.revoke(connection, identifier)
        if project is not None:
            audit.record_operator(connection, project, "key.revoke", identifier)
        return project

    if _existing(settings_of(config, data=data), lambda database: database.transact(work)) is None:
        raise RequestError(f"{identifier}: there is no such key that is not revoked")
    print(f"revoked  {identifier}")


def audit(
    project: ProjectOption = None,
    limit: Annotated[int, typer.Option("--limit", min=1, help="Lines at most.")] = 100,
    data: DataOption = None,
    config: ConfigOption = None,
) -> None:
    """Show who did what to which object, the newest first."""
    from service.server.database import audit as log

    rows = [("TIME (UTC)", "PROJECT", "WHO", "ACTION", "OBJECT", "REQUEST")]
    rows += [(_time(row["at"]), row["project"], row["actor"], row["action"], row["object"], row["request"] or "")
             for row in _existing(settings_of(config, data=data), lambda database: log.listing(database, project=project, limit=limit))]
    print_table(rows)


def _time(seconds: float | None) -> str:
    return "" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M")


def _existing(settings: Any, work: "Callable[[Database], T]") -> T:
    """Do something with the database of an existing service; a wrong --data makes no new one."""
    from service.errors import RequestError
    from service.server.database.engine import connect, usable
    from service.server.database.schema import require_current

    if settings.is_sqlite and not settings.sqlite_file.exists():
        raise RequestError(f"data {settings.data}: there is no service in this folder")
    with usable(settings), closing(connect(settings.sqlalchemy_url)) as database:
        require_current(database)
        return work(database)
