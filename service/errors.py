"""One table from what can go wrong to what a person is told.

RequestError       a request asks for something that cannot be (frames backwards, a pattern without ####); names the option
ValidationError    pydantic's: a value of a request cannot be; names the field
"""

from pydantic import ValidationError

from kernels.errors import KernelError
from service.usd.errors import AssetError
from stage.errors import StageError
from stage.records import describe


class RequestError(ValueError):
    """A request is wrong: the message names the option."""


USER_ERRORS: tuple[type[Exception], ...] = (RequestError, ValidationError, StageError, KernelError, AssetError)
"""Errors whose text is a sentence for the person who asked: exit code 2 on the command line."""


def sentence(error: BaseException) -> str:
    """The one line to show: names of files and fields come into it as others wrote them, so what is not plain text is escaped."""
    if isinstance(error, ValidationError):
        raised = (fault.get("ctx", {}).get("error") for fault in error.errors())
        text = next((str(found) for found in raised if isinstance(found, RequestError)), None) or describe(error)
    else:
        text = " ".join(str(error).split())
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)
