"""Groups of commands, whose help is plain text: option names are never cut, whatever the width of the terminal, and nothing is imported
to draw frames."""

from typing import Any

import typer
from typer.core import TyperGroup

NO_COMMAND = 2
"""The exit code where no command is given: the help is shown, and nothing was done."""


class _Group(TyperGroup):
    """A group that lists its commands with their whole first sentence; Typer cuts it to one line."""

    def list_commands(self, ctx: Any) -> list[str]:
        for command in self.commands.values():
            if command.short_help is None and command.help is not None:
                command.short_help = _first_sentence(command.help)
        return super().list_commands(ctx)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args and not ctx.resilient_parsing:  # before Typer makes an error of it, whose message would be the whole help
            typer.echo(ctx.get_help(), err=True)
            ctx.exit(NO_COMMAND)
        return super().parse_args(ctx, args)


def make_group(name: str | None = None, *, help: str) -> typer.Typer:
    """Return a group of commands, which shows its help when no command is given; the parameters are Typer's."""
    return typer.Typer(name=name, cls=_Group, help=help, rich_markup_mode=None, add_completion=False,
                       pretty_exceptions_enable=False)


def _first_sentence(text: str) -> str:
    paragraph = " ".join(text.split("\n\n")[0].split())
    sentence, stop, _ = paragraph.partition(". ")
    return sentence + stop.rstrip()
