"""The controllers of lamps that are switched by lines on a serial port or by HTTP requests, as a rig file describes them."""

import re
from string import Formatter
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from stage.model import Positive, Strict, Text

FIELDS = ("index", "number", "name", "level")
"""The fields of a command: the place of the lamp in the rig's file, from 0 and from 1, its name, and its level, 0 to 255."""


def _command(text: str) -> str:
    try:
        fields = [name for _, name, _, _ in Formatter().parse(text) if name is not None]
        text.format(**dict.fromkeys(FIELDS, 0))
    except (ValueError, LookupError, AttributeError) as error:
        raise ValueError(f"cannot be filled in ({error}): the fields are {{index}}, {{number}}, {{name}} and {{level}}") from error
    for name in fields:
        if name not in FIELDS:
            raise ValueError(f"has the field {{{name}}}: the fields are {{index}}, {{number}}, {{name}} and {{level}}")
    return text


def _pattern(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"is no regular expression: {error}") from error
    return text


Command = Annotated[str, Field(min_length=1, max_length=10_000), AfterValidator(_command)]
"""A text with the fields of a lamp in braces."""


class SerialController(Strict):
    """A controller of lamps at a serial port, as home-made domes have it."""

    port: Text
    """The serial port, such as /dev/ttyUSB0 or COM3."""
    baud: Annotated[int, Field(ge=50, le=4_000_000)] = 115200
    """Bits per second."""
    on: Command
    """What is sent to light a lamp, such as "on {index}\\n"."""
    off: Command
    """What is sent to darken a lamp, such as "off {index}\\n"; without a field of the lamp, all lamps."""
    acknowledge: Annotated[str, AfterValidator(_pattern)] | None = None
    """The regular expression of the line with which the controller answers a command; None: it does not answer."""
    timeout_s: Positive = 2.0
    """The longest time until the answer."""
    ready_s: Annotated[float, Field(ge=0, le=60)] = 2.0
    """The time from opening the port until commands are heard: many boards start anew when it is opened."""


class HttpRequest(Strict):
    """An HTTP request."""

    method: Literal["GET", "POST", "PUT"] = "GET"
    """The method."""
    url: Command
    """The address."""
    body: Command | None = None
    """The body; braces that are no fields are doubled. None: none."""
    content_type: Text = "application/json"
    """The type of the body."""


class HttpController(Strict):
    """A controller of lamps that takes HTTP requests."""

    on: HttpRequest
    """The request that lights a lamp."""
    off: HttpRequest
    """The request that darkens a lamp; without a field of the lamp, all lamps."""
    timeout_s: Positive = 5.0
    """The longest time until the answer, whose status must be 2xx."""


class Controllers(Strict):
    """The controllers of a rig."""

    serial: SerialController | None = None
    """The controller of lamps whose address has the protocol serial."""
    http: HttpController | None = None
    """The controller of lamps whose address has the protocol http."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.http is not None:
            for name, request in (("on", self.http.on), ("off", self.http.off)):
                if not request.url.startswith(("http://", "https://")):
                    raise ValueError(f"http.{name}.url is {request.url}: give an address that begins with http:// or https://")
        return self

    def dims(self, protocol: str) -> bool:
        """Return whether the command that lights a lamp of a protocol, serial or http, says its level."""
        command = {"serial": self.serial and self.serial.on, "http": self.http and f"{self.http.on.url}{self.http.on.body or ''}"}
        return "level" in _fields(command.get(protocol) or "")


def per_lamp(command: str) -> bool:
    """Return whether a command names a lamp; else it stands for all lamps."""
    return bool(_fields(command) & {"index", "number", "name"})


def _fields(command: str) -> set[str | None]:
    return {name for _, name, _, _ in Formatter().parse(command)}


def filled(command: str, index: int, name: str, level: float) -> str:
    """Return a command for a lamp at a level, 0 to 1."""
    return command.format(index=index, number=index + 1, name=name, level=round(255 * level))
