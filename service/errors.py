"""The errors whose text is a sentence for the person who asked, and the line that is shown for each.

RequestError       a request asks for something impossible (frames that run backwards, a name without ####); names the option
AssetError         these maps, or this path, cannot become an asset; says what is missing and what to do
ValidationError    pydantic's: a field of a request has an invalid value; names the field
DivergedError      a worker that helps finds something else than the one that has the job; only the log says so
"""

from pydantic import ValidationError

from kernels.errors import KernelError
from stage.errors import StageError
from stage.records import FieldName, describe, field_name


class RequestError(ValueError):
    """A request asks for something impossible; the message names the option."""


class AssetError(ValueError):
    """The maps or the path cannot become an asset; its text is one plain sentence."""


class SurfaceError(AssetError):
    """What results hold makes no surface; whoever has read them names their file before its text."""


class DivergedError(Exception):
    """This worker's results differ from those of the worker that has the job, so that it cannot help."""


USER_ERRORS: tuple[type[Exception], ...] = (RequestError, ValidationError, StageError, KernelError, AssetError)
"""Errors whose text is a sentence for the person who asked: exit code 2 on the command line."""


def sentence(error: BaseException, name: FieldName = field_name) -> str:
    """Return the line to show for an error.

    Names of files and fields stand in it as others wrote them, so characters that cannot be printed are escaped.

    Args:
        error: what was raised.
        name: names the field of a request with an invalid value.
    """
    if isinstance(error, ValidationError):
        raised = (fault.get("ctx", {}).get("error") for fault in error.errors())
        text = next((str(found) for found in raised if isinstance(found, RequestError)), None) or describe(error, name)
    else:
        text = " ".join(str(error).split())
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)


def sentences(error: BaseException) -> list[str]:
    """Return the lines to show for an error, one for each fault that it lists."""
    if isinstance(error, StageError) and len(error.args) > 1:
        return [sentence(StageError(fault)) for fault in error.args]
    return [sentence(error)]
