"""The option --ocio, which every command takes that works on this machine."""

import os
from contextlib import AbstractContextManager, nullcontext
from typing import Annotated

import typer

from stage.colour.location import VARIABLE

OcioOption = Annotated[str | None, typer.Option(
    "--ocio", metavar="FILE|ocio://…", show_default=False,
    help="OpenColorIO configuration whose colour spaces the images have; without it that of $OCIO, else ocio://default.")]


def colours(place: str | None) -> AbstractContextManager[None]:
    """Return the context of a command: the configuration of colours that --ocio or $OCIO names, checked before any work."""
    if place is None and not os.environ.get(VARIABLE):
        return nullcontext()
    from stage.colour.configuration import used  # which loads an image library

    return used(place)
