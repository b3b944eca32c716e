"""The list of commands that `relit --help` shows, in a file: to import every command takes two times as long as to show it.

`python -m service.cli.listing` writes the file from the commands; a test compares the two.
"""

import json
from pathlib import Path

import typer

from service.cli.groups import make_group

LISTING = Path(__file__).with_name("listing.json")
"""The help of each command of the program by its name, in the order in which they are shown."""


def listed_commands(app: typer.Typer) -> dict[str, str]:
    """Return the help of each command and group of commands of a program by its name."""
    group = typer.main.get_group(app)
    return {name: command.help or "" for name, command in group.commands.items()}


def listing_program(*, help: str) -> typer.Typer:
    """Return a program that shows the list of commands, and can do nothing else."""
    app = make_group("relit", help=help)
    for name, words in json.loads(LISTING.read_text(encoding="utf-8")).items():
        app.command(name, help=words)(_stand_in)
    return app


def _stand_in() -> None:
    """Take the place of a command in the list; this program runs none."""


def _main() -> None:
    from service.cli.main import program
    from stage.files import write_text

    write_text(LISTING, json.dumps(listed_commands(program()), indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    _main()
