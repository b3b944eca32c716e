"""relit hooks: URLs that a service tells how the jobs of a project have ended."""

import sys
from typing import Annotated

import typer

from service.cli.groups import make_group
from service.cli.printing import print_table
from service.cli.remote import KeyOption, ServerOption, connected
from service.cli.request_commands import command
from service.requests.base.identifiers import DEFAULT_SERVER
from service.requests.hooks import NewHook

HookArgument = Annotated[str, typer.Argument(metavar="HOOK", help="Identifier of the hook: hook_….", show_default=False)]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = make_group(help="Let a service tell a URL how the jobs of a project have ended; list, test and delete such hooks.")
    command(group, "create", _create)
    group.command("list")(list_)
    group.command("test")(test)
    group.command("delete")(delete)
    app.add_typer(group, name="hooks")


def _create(wanted: NewHook, server: ServerOption = DEFAULT_SERVER, key: KeyOption = None) -> None:
    with connected(server, key) as client:
        made = client.hooks.create(wanted)
    print(f"hook        {made.id}")
    print(f"secret      {made.secret}")
    print("keep the secret: it is not shown again", file=sys.stderr)


def list_(server: ServerOption = DEFAULT_SERVER, key: KeyOption = None) -> None:
    """Show the hooks of the project, and what came of the last delivery to each."""
    rows = [("HOOK", "EVENTS", "WAITING", "LAST TRY (UTC)", "LAST ANSWER", "URL")]
    with connected(server, key) as client:
        for hook in client.hooks.all():
            last = hook.last_delivery
            tried = "" if last is None or last.tried_at is None else f"{last.tried_at:%Y-%m-%d %H:%M}"
            answer = "" if last is None else last.answer or ""
            rows.append((hook.id, ",".join(hook.events), str(hook.waiting), tried, answer, hook.url))
    print_table(rows)


def test(hook: HookArgument, server: ServerOption = DEFAULT_SERVER, key: KeyOption = None) -> None:
    """Let the service send a test to a hook; relit hooks list shows what came of it."""
    with connected(server, key) as client:
        print(f"delivery    {client.hooks.test(hook).id}")


def delete(hook: HookArgument, server: ServerOption = DEFAULT_SERVER, key: KeyOption = None) -> None:
    """Delete a hook: what waits is not sent any more."""
    with connected(server, key) as client:
        client.hooks.delete(hook)
    print(f"deleted     {hook}")
