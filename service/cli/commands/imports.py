"""relit import LAYOUT: make a capture of files that are laid out another way, and say how they were understood."""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.groups import make_group
from service.cli.remote import KeyOption
from service.cli.request_commands import product_command
from service.requests.imports.layouts import LAYOUTS, request_of, taken_apart
from service.requests.imports.patterns import InterleavedImport, StereoImport
from service.requests.imports.scans import ScansImport

if TYPE_CHECKING:
    from stage.importers.folder import Guess
    from stage.importers.layout import Imported

FolderArgument = Annotated[Path, typer.Argument(metavar="SRC", help="Folder of the data.", show_default=False)]
DestinationArgument = Annotated[Path | None, typer.Argument(metavar="DST", show_default=False, help=(
    "Folder for the capture, which gets links to the files; without it capture.json is written beside them."))]

ToOption = Annotated[str | None, typer.Option(
    "--to", metavar="URL", show_default=False, help=(
        "Send the capture to this service, as relit serve prints its address; DST may be left out."))]

IMPORT = "service.captures.importing:import_files"
"""The product that writes a capture.json for files of any layout."""


def register(app: typer.Typer) -> None:
    """Add the commands."""
    layouts = make_group("import", help="Write a capture.json for files that are laid out another way; docs/importing.md shows each.")
    for name, model in LAYOUTS.items():
        product_command(layouts, name, model, IMPORT, partial(_print, "capture"))
    product_command(layouts, "stereo", StereoImport, IMPORT, partial(_print, "capture"))  # of two folders: no layout of an upload
    product_command(layouts, "scans", ScansImport, "service.scans.importing:import_scans", partial(_print, "set"))
    product_command(layouts, "interleaved", InterleavedImport, "service.acquisition.performance:import_interleaved",
                    partial(_print, "sequence"))
    layouts.command("guess")(_guess)

    @layouts.command("auto")
    def auto(folder: FolderArgument, destination: DestinationArgument = None, to: ToOption = None, key: KeyOption = None) -> None:
        """Import a folder as guess proposes, where the files say all that the command needs; else name the commands to choose from."""
        if to is None:
            _auto(folder, destination)
            return
        with TemporaryDirectory(prefix="relit-import-") as work:  # of links, so that the files of captures alone are sent
            _upload(_auto(folder, destination or Path(work) / folder.resolve().name, kept=destination is not None), to, key)

    app.add_typer(layouts)


def _guess(folder: FolderArgument) -> None:
    """Look at a folder: what it seems to be, why, how sure that is, and the command that imports it."""
    from stage.importers.guess import guess_each

    for found in guess_each(folder):
        _print_guess(found)
        print(f"run      {found.command}")
        print(f"then     {found.then}")


def _auto(folder: Path, destination: Path | None, *, kept: bool = True) -> list[Path]:
    """Run the import of a folder, or of each folder in it, record in its capture.json what the guess assumed, and return the captures.
    `kept`: whether they stay; nothing is said of places that do not."""
    from service.captures.importing import import_files
    from stage.errors import ManifestError
    from stage.importers.guess import guess_each

    guesses = guess_each(folder)
    unsure = [found for found in guesses if not found.sure]
    if unsure:
        assumed = "; ".join(unsure[0].assumed)
        raise ManifestError(f"{folder}: looks like {unsure[0].layout}, and the files do not say all that its import needs ({assumed}): "
                            + "; ".join(found.command for found in unsure))
    made = []
    for found in guesses:
        target = destination if destination is None or len(guesses) == 1 else destination / found.source.name
        _print_guess(found)
        typed = taken_apart(found.arguments)
        imported = import_files(request_of(typed.layout, typed.source, target, typed.options), assumed=found.assumed)
        if kept:
            _print("capture", imported)
            print(f"then     {found.then if target is None else found.then.replace(str(found.source), str(target), 1)}")
        made.append(imported.path.parent)
    return made


def _upload(captures: list[Path], server: str, key: str | None) -> None:
    from service.cli.progress import ProgressBar
    from service.cli.remote import connected

    with connected(server, key) as client:
        for folder in captures:
            with ProgressBar() as bar:
                print(f"sent     {client.captures.upload(folder, progress=bar).id}")


def _print_guess(found: "Guess") -> None:
    print(f"looks    like {found.layout}")
    print(f"because  {found.reason}")
    for sentence in found.assumed:
        print(f"assumed  {sentence}")
    print(f"sure     {'yes' if found.sure else 'no: the assumptions, or words in capitals, are yours to check'}")


def _print(made: str, imported: "Imported") -> None:
    """Print where the capture, or what else was made, is, and how the files were understood."""
    print(f"{made:<8} {imported.path}")
    for name, sentence in imported.facts:
        print(f"{name:<8} {sentence}")
