"""The options of pictures for review, which a display shows: the view and the looks of the OpenColorIO configuration."""

from typing import Annotated

from pydantic import AfterValidator

from service.requests.base.base import Options, Role, Spelling
from stage.colour.colour_spaces import Review
from stage.model import Line


def _view(view: str | None) -> str | None:
    if view is not None:
        from stage.colour.configuration import current  # which loads an image library

        current().view(view)
    return view


def _look(look: str | None) -> str | None:
    if look is not None:
        from stage.colour.configuration import current

        current().checked_look(look)
    return look


class ReviewOptions(Options):
    """Base of the requests that make pictures for review."""

    view: Annotated[Line | None, AfterValidator(_view), Role.RUN, Spelling(metavar="DISPLAY/VIEW")] = None
    """View of the OpenColorIO configuration through which pictures for review are shown, such as "sRGB - Display/Un-tone-mapped" or the
    view alone; None: ACES 2.0 at 100 nits, or the default view of a configuration without it."""
    look: Annotated[Line | None, AfterValidator(_look), Role.RUN, Spelling(metavar="LOOK,-LOOK,…")] = None
    """Looks of the configuration that these pictures have, in place of those of the view: names with commas between, in this order, one
    with - before it undone; None: those of the view."""

    @property
    def review(self) -> Review:
        """Return the view and the looks."""
        return Review(self.view, self.look)

    def require_picture(self, **paths: object) -> None:
        """Raise RequestError if there is a view or a look, and none of the pictures, which options would ask for."""
        from service.errors import RequestError  # which loads more than a client needs

        flags = " or ".join(f"--{name}" for name in paths)
        for name, given in self.review._asdict().items():
            if given is not None and not any(paths.values()):
                raise RequestError(f"--{name} {given}: is for the picture of {flags}: give {flags} too")
