"""The base of every request: a frozen model whose fields are the only declaration of options, their defaults and their words.

An ...Options model holds what is chosen about the work; the ...Request on top of it adds where files are. A job of the service carries
the options and names of captures, which its worker makes paths of.
"""

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict


def split_commas(given: Any) -> Any:
    """Return the words of a text with commas between them, and a list as a tuple, which strict validation of JSON asks for."""
    if isinstance(given, str):
        return tuple(part.strip() for part in given.split(","))
    return tuple(given) if isinstance(given, list) else given


class Options(BaseModel):
    """Base of every model: what is not known is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Request(Options):
    """Base of every request."""

    device: str | None = None
    """cpu, cuda:0, …; None: the first CUDA device, else the CPU."""
    cache: Path | None = None
    """Folder for the stack cache; None: `.relit` in the capture's folder."""


class StackOptions(Options):
    """About the images of a capture."""

    align: bool = False
    """Warp the frames of a moving subject to the time of one tracking frame."""
    align_to: str | None = None
    """Image of that tracking frame, and so `align`; None: the middle one."""

    @property
    def aligned(self) -> bool:
        """Whether frames are warped."""
        return self.align or self.align_to is not None
