"""Parameters of a job: what is asked of whoever submits it, and the values that this program was given for them.

Texts that a person chose are always parameters. A template is a form in which {{…}} is filled in, and a parameter's value is not looked
through again; so no path or name, whatever is in it, is taken for anything else. No shell reads them either.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from service.errors import RequestError
from service.farm.document import Plain

LONGEST = 1024
"""Characters of a value, by the specification."""


class Job(NamedTuple):
    """A template, and values for those of its parameters that have no default."""

    template: Mapping[str, Plain]
    values: Mapping[str, str]


class Parameters:
    """Parameters in the order in which they are asked for."""

    def __init__(self) -> None:
        """None yet."""
        self.definitions: list[Mapping[str, Plain]] = []
        self.values: dict[str, str] = {}

    def text(self, name: str, value: str, about: str) -> str:
        """A text with a default; where it is filled in."""
        self.definitions.append({"name": name, "type": "STRING", "default": _checked(value), "description": about})
        return f"{{{{Param.{name}}}}}"

    def count(self, name: str, value: int, about: str) -> str:
        """A number from 1 on with a default; where it is filled in."""
        self.definitions.append({"name": name, "type": "INT", "default": value, "minValue": 1, "description": about})
        return f"{{{{Param.{name}}}}}"

    def file(self, name: str, value: Path, about: str) -> str:
        """A file that is read; where it is filled in."""
        return self._path(name, value, "FILE", "IN", about)

    def folder(self, name: str, value: Path, flow: str, about: str) -> str:
        """A folder that is read (IN), written (OUT) or neither (NONE); where it is filled in."""
        return self._path(name, value, "DIRECTORY", flow, about)

    def _path(self, name: str, value: Path, kind: str, flow: str, about: str) -> str:
        # a path has no default: the specification wants those within the template's folder
        self.definitions.append({"name": name, "type": "PATH", "objectType": kind, "dataFlow": flow, "description": about})
        self.values[name] = _checked(str(value.absolute()))
        return f"{{{{Param.{name}}}}}"


def _checked(text: str) -> str:
    if len(text) > LONGEST:
        raise RequestError(f"{text[:40]}…: has {len(text)} characters, a value of a farm's job {LONGEST} at the most")
    if any(ord(character) < 32 or ord(character) == 127 for character in text):
        raise RequestError(f"{text!r}: holds a control character, which no value of a farm's job may")
    return text
