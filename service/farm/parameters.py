"""The parameters of a job: what the person who submits it may change, with the values that this program was given.

Texts that a person chose are always parameters. A template is a form in which {{…}} is filled in, and a parameter's value is not looked
through again; so no path or name, whatever is in it, is taken for anything else. No shell reads them either.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.errors import RequestError
from service.requests.base.base import Request, Role
from service.requests.base.options import Option, help_text, typed, values_of

LONGEST = 1024
"""The specification's limit on the characters of a value."""


class Parameters:
    """Parameters in the order of the template. Each method adds one and returns the text that stands for its value there."""

    def __init__(self) -> None:
        self.definitions: list[Mapping[str, Any]] = []
        self.values: dict[str, str] = {}
        """The values of the parameters that have no default."""

    def text(self, name: str, value: str, about: str) -> str:
        """Add a text with a default."""
        return self._add(name, "STRING", about, default=_checked(value))

    def count(self, name: str, value: int, about: str) -> str:
        """Add a number from 1 on with a default."""
        return self._add(name, "INT", about, default=value, minValue=1)

    def file(self, name: str, value: Path, about: str) -> str:
        """Add a file that is read."""
        return self._path(name, value, "FILE", "IN", about)

    def folder(self, name: str, value: Path, flow: str, about: str) -> str:
        """Add a folder that is read (IN), written (OUT) or neither (NONE)."""
        return self._path(name, value, "DIRECTORY", flow, about)

    def words(self, request: Request) -> list[str]:
        """Return the words that type the input and the choices of a request, where they are not at their default."""
        arguments, rest = [], []
        for option, value in values_of(request):
            if value == option.field.default or option.role not in (Role.INPUT, Role.CHOICE):
                continue
            if option.spelling.argument:
                arguments.append(self._word(option, value, request))
            elif option.kind is bool:
                rest.append(option.flag if value else option.off)
            else:
                for each in value if option.is_repeated else (value,):
                    rest += [option.flag, self._word(option, each, request)]
        return [*arguments, *rest]

    def _word(self, option: Option, value: Any, request: Request) -> str:
        name = option.name.title().replace("_", "")
        about = help_text(option, type(request))
        if option.kind is str:
            return self.text(name, value, about)
        if option.role is not Role.INPUT:
            return typed(value)
        if "#" in value.name and not value.is_file():
            folder = self.folder(f"{name}Folder", value.parent, "IN", f"Folder of the files of {name}Name.")
            return f"{folder}/{self.text(f'{name}Name', value.name, about)}"
        return self.folder(name, value, "IN", about) if value.is_dir() else self.file(name, value, about)

    def _path(self, name: str, value: Path, kind: str, flow: str, about: str) -> str:
        self.values[name] = _checked(str(value.absolute()))
        # a path has no default: the specification wants those within the template's folder
        return self._add(name, "PATH", about, objectType=kind, dataFlow=flow)

    def _add(self, name: str, kind: str, about: str, **others: Any) -> str:
        self.definitions.append({"name": name, "type": kind, **others, "description": about})
        return f"{{{{Param.{name}}}}}"


def _checked(text: str) -> str:
    if len(text) > LONGEST:
        raise RequestError(f"{text[:40]}…: has {len(text)} characters, a value of a farm's job {LONGEST} at the most")
    if any(ord(character) < 32 or ord(character) == 127 for character in text):
        raise RequestError(f"{text!r}: holds a control character, which no value of a farm's job may")
    return text
