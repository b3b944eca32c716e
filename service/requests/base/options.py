"""The options of a request, read from the fields of its model.

A field is the only place where an option stands: its name, type, default and limits; its words, in the docstring below it; its `Role`;
and its `Spelling`, where the rule does not give the wanted one. By the rule a field `spin_degrees` is typed `--spin-degrees`, a switch
that is on by default `--refine/--no-refine`, a tuple with `Commas` as one text with commas between, and any other tuple by giving the
option several times. The fields of a model within a model are options like its own.

The command line, `relit submit`, the templates for farms, the forms of the pages and the provenance of results are made from this.
"""

import re
import types
from collections.abc import Iterator, Mapping
from functools import cache
from inspect import get_annotations
from keyword import iskeyword
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from service.requests.base.base import Choice, Commas, Options, Role, Spelling
from stage.files import require_writable

Model = TypeVar("Model", bound=Options)


class Option(NamedTuple):
    """An option, as a field of a model declares it."""

    name: str
    """Name of the parameter: that of the field, or of its flag."""
    field: FieldInfo
    kind: Any
    """The type of the value, without None and constraints."""
    constraints: tuple[Any, ...]
    """The limits and validators of the value."""
    role: Role
    spelling: Spelling

    @property
    def flag(self) -> str:
        """The flag that gives the value, or turns the switch on."""
        return self.spelling.flag or f"--{self.name.replace('_', '-')}"

    @property
    def off(self) -> str:
        """The flag that turns a switch off."""
        return self.spelling.off or f"--no-{self.flag.removeprefix('--')}"

    @property
    def pattern(self) -> str | None:
        """The regular expression of the text, or of each of several texts; None where there is none."""
        inner = FieldInfo.from_annotation(get_args(self.kind)[0]).metadata if self.is_repeated else ()
        return next((found for limit in (*self.constraints, *inner) if (found := getattr(limit, "pattern", None)) is not None), None)

    @property
    def is_repeated(self) -> bool:
        """Return whether several values are typed by giving the option several times."""
        return get_origin(self.kind) is tuple and get_args(self.kind)[-1] is Ellipsis and Commas not in self.constraints


@cache
def options_of(model: type[BaseModel]) -> tuple[Option, ...]:
    """Return the options of a model, those that it declares before those of its bases, each name once."""
    found: dict[str, Option] = {}
    for name, field in _fields(model):
        inner = nested(field)
        options = options_of(inner) if inner is not None else () if _is_constant(field) else (_option(name, field),)
        for option in options:
            found.setdefault(option.name, option)
    return tuple(found.values())


def places_of(model: type[BaseModel]) -> Iterator[tuple[tuple[str, ...], Option]]:
    """Yield the options of a model with the place of each in its JSON: the names of the fields that lead to it."""
    for name, field in _fields(model):
        inner = nested(field)
        if inner is not None:
            yield from (((name, *path), option) for path, option in places_of(inner))
        elif not _is_constant(field):
            yield (name,), _option(name, field)


def build(model: type[Model], given: Mapping[str, Any]) -> Model:
    """Make a model from options by name; what is not given has its default."""
    return model.model_validate(_values(model, given))


def _values(model: type[BaseModel], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return options by name as the values of a model's fields, those of a model within it in a dictionary of their own."""
    values: dict[str, Any] = {}
    for name, field in _fields(model):
        inner = nested(field)
        if inner is not None:
            if any(option.name in given for option in options_of(inner)):
                values[name] = _values(inner, given)
        elif _is_constant(field):
            values[name], = get_args(field.annotation)
        elif (option := _option(name, field)).name in given:
            values[name] = given[option.name]
    return values


def typed_name(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    """Return how the value at a place of a request is named where it is typed, such as `--max-sigma`, or `--aov, value 2` of a list."""
    for place, option in places_of(model):
        if location[: len(place)] == place:
            inside = [f"value {part + 1}" if isinstance(part, int) else part for part in location[len(place) :]]
            shown = (option.spelling.metavar or option.name.upper()) if option.spelling.argument else option.flag
            return ", ".join([shown, *inside])
    return ".".join(map(str, location))


def values_of(request: BaseModel) -> Iterator[tuple[Option, Any]]:
    """Return the options of a request with their values: the inverse of `build`."""
    for name, field in _fields(type(request)):
        value = getattr(request, name)
        if nested(field) is not None:
            yield from values_of(value)
        elif not _is_constant(field):
            yield _option(name, field), value


def nested(field: FieldInfo) -> type[Options] | None:
    """Return the model whose fields are options of the model around it, or None where the field is one value."""
    kind, _ = _value_type(field)
    return kind if isinstance(kind, type) and issubclass(kind, Options) else None


def require_outputs(request: BaseModel) -> None:
    """Raise StorageError where results cannot be written: before the work, which may take hours, and not after it."""
    for option, value in values_of(request):
        if option.role in (Role.OUTPUT, Role.FILE) and isinstance(value, Path):
            require_writable(value, folder=option.role is Role.OUTPUT)


def is_document(kind: Any) -> bool:
    """Return whether the values of a type are JSON documents, each with a schema of its own, which a person gives as a file."""
    return isinstance(kind, type) and issubclass(kind, BaseModel) and not issubclass(kind, Options)


def role_of(field: FieldInfo) -> Role:
    """Return the role of a field."""
    return next((data for data in field.metadata if isinstance(data, Role)), Role.CHOICE)


def help_text(option: Option, model: type[BaseModel]) -> str:
    """Return the words of an option for a person who types it: flags in place of names of fields, `without it` in place of `None:`."""
    flags = {other.name: other.flag for other in options_of(model)}
    text = " ".join((option.field.description or "").split())
    text = re.sub(r"`(\w+)`", lambda found: flags.get(found[1], found[1]), text)
    text = re.sub(r"(^|[.] )None: ", r"\1Without it ", text).replace("None: ", "without it ")
    kind = get_args(option.kind)[0] if get_origin(option.kind) is tuple else option.kind
    explained = kind.explained() if isinstance(kind, type) and issubclass(kind, Choice) else ""
    return f"{text} {explained}." if explained else text


def typed(value: Any) -> str:
    """Return a value as it is typed: the inverse of what the validators of the fields take apart."""
    if isinstance(value, BaseModel):
        value = tuple(value.model_dump(exclude_defaults=True).values())
    if isinstance(value, tuple):
        return ",".join(map(typed, value))
    if isinstance(value, float):
        short = f"{value:g}"
        return short if float(short) == value else repr(value)
    return str(value)


def _fields(model: type[BaseModel]) -> Iterator[tuple[str, FieldInfo]]:
    names = {name: None for cls in model.__mro__ for name in get_annotations(cls)}
    return ((name, model.model_fields[name]) for name in names if name in model.model_fields)


def _is_constant(field: FieldInfo) -> bool:
    return get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1


def _value_type(field: FieldInfo) -> tuple[Any, tuple[Any, ...]]:
    """Return the type of a field's value without `| None`, and the constraints that stand inside and outside of that."""
    kind = field.annotation
    if get_origin(kind) in (Union, types.UnionType):
        kinds = [each for each in get_args(kind) if each is not types.NoneType]
        if len(kinds) == 1:
            inner = FieldInfo.from_annotation(kinds[0])
            return inner.annotation, (*field.metadata, *inner.metadata)
    return kind, tuple(field.metadata)


def _option(name: str, field: FieldInfo) -> Option:
    kind, constraints = _value_type(field)
    spelling = next((data for data in constraints if isinstance(data, Spelling)), Spelling())
    if spelling.flag is not None:
        name = spelling.flag.removeprefix("--").replace("-", "_")
    return Option(f"{name}_" if iskeyword(name) else name, field, kind, constraints, role_of(field), spelling)
