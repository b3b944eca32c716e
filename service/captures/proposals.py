"""Proposals for uploaded files that are no capture: what they seem to be, what is left to be chosen, and the import that was chosen.

These functions read untrusted files: `service.captures.check_process` calls them in a process of its own.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.captures.importing import import_files
from service.requests.base.base import Role
from service.requests.base.import_choices import ImportChoices
from service.requests.imports.layouts import LAYOUTS, options_of_layout, request_of, taken_apart, unsettled
from stage.capture.manifest import read_manifest, write_manifest
from stage.errors import ManifestError
from stage.importers.guess import guess
from stage.importers.video import is_video


def propose(folder: Path) -> dict[str, Any]:
    """Return how the files of a folder can be imported, as JSON.

    Returns:
        `summary` and `because`, sentences; `layout`, `file` and `options` as ImportChoices has them; `missing`, the names of options that a
        person has to choose; `assumed`, sentences; `sure`, whether the files say all that the import needs.

    Raises:
        ManifestError: the files are of no layout that can be imported; the sentence says what was looked for.
    """
    found = guess(folder)
    if found.arguments[0] not in LAYOUTS:
        raise ManifestError(f"{folder}: looks like {found.layout}, which relit import {found.arguments[0]} takes, and the service does not")
    typed = taken_apart(found.arguments)
    _require_no_video(typed.layout, typed.source)
    missing = unsettled(typed.layout, typed.options)
    known = options_of_layout(typed.layout)
    asked = [str(typed.options[name]) for name in missing if name in typed.options]  # such as FOCAL, which the form asks for
    assumed = [sentence for sentence in found.assumed if not any(word in sentence for word in asked)]
    options = {name: str(Path(value).relative_to(folder)) if known[name].role is Role.INPUT else value
               for name, value in typed.options.items() if name not in missing}
    return {"summary": found.summary, "because": found.reason, "layout": typed.layout,
            "file": None if typed.source == folder else str(typed.source.relative_to(folder)), "options": options, "missing": missing,
            "assumed": assumed, "sure": found.sure and not missing}


def import_chosen(folder: Path, choices: ImportChoices, assumed: tuple[str, ...], name: str) -> None:
    """Write the capture.json of a folder as it was chosen.

    Args:
        assumed: the sentences of the proposal that are still true.
        name: that the capture is to have.
    """
    _require_no_video(choices.layout, folder / (choices.file or ""))
    known = options_of_layout(choices.layout)
    options = {key: folder / value if key in known and known[key].role is Role.INPUT and isinstance(value, str) else value
               for key, value in choices.options.items()}
    path = import_files(request_of(choices.layout, folder / (choices.file or ""), folder, options), assumed).path
    write_manifest(read_manifest(path).model_copy(update={"name": name}), path)


def _require_no_video(layout: str, source: Path) -> None:
    """Refuse a video, whose decoder sets no bounds to what a file asks of it."""
    if is_video(source):
        raise ManifestError(f"{source}: is a video: unpack it with relit import {layout if layout == 'phase' else 'gray'} on your machine, "
                            "and upload the folder that it writes")


def still_assumed(proposal: Mapping[str, Any], choices: ImportChoices) -> tuple[str, ...]:
    """Return the assumptions of a proposal that hold for what was chosen: none where another import was, or another value than proposed,
    and not those about an option that was chosen beside it."""
    options = choices.options
    if choices.layout != proposal["layout"]:
        return ()
    chosen, as_proposed = (request_of(choices.layout, Path(), None, values) for values in (options, {**options, **proposal["options"]}))
    if chosen != as_proposed:
        return ()
    known = options_of_layout(choices.layout)
    flags = [known[name].flag for name in options if name in known and name not in proposal["options"]]
    return tuple(sentence for sentence in proposal["assumed"] if not any(flag in sentence for flag in flags))
