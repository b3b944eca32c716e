"""Reading of JSON files by a schema, with one sentence about each fault, which names the file and the field."""

import json
import re
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from stage import inputs
from stage.errors import ManifestError, listed

Record = TypeVar("Record", bound=BaseModel)
FieldName = Callable[[tuple[int | str, ...]], str]
"""Makes the name of a field, as a sentence has it, from its pydantic location."""
MAX_KEYS = 1000
"""The most keys of a JSON object: no schema has as many, and an error is collected for each unknown key."""
MOST_SHOWN = 60
"""The most characters of a value or a key that a sentence repeats."""
IDENTIFIER = re.compile(r"\^(\w+_)\[")
"""Finds the prefix in the pattern of identifiers that a program gives out, which nobody makes up."""


def read_record(path: str | Path, model: type[Record], further: Callable[[dict[str, Any]], Iterator[str]] | None = None) -> Record:
    """Read a JSON file and check it against a model, whose key `schema` it must have.
    `further`: finds faults of content that is wrong, as `field: what is wrong`, among them those that the model does not report because it
    stops at the first fault of a long list."""
    schema = schema_of(model)
    if Path(path).is_dir():
        raise ManifestError(f"{path}: is a folder: give a JSON file with the schema {schema}")
    text = inputs.read_bytes(path)
    try:
        data = json.loads(text, object_pairs_hook=_unique_keys, parse_constant=_refuse_constant)
    except UnicodeDecodeError as error:
        raise ManifestError(f"{path}: is not UTF-8 text: this program reads JSON with the schema {schema}") from error
    except json.JSONDecodeError as error:
        raise ManifestError(f"{path}: is not JSON: {error.msg} at line {error.lineno}, column {error.colno}") from error
    except RecursionError as error:
        raise ManifestError(f"{path}: is nested too deeply") from error
    except ValueError as error:
        raise ManifestError(f"{path}: {error}") from error
    if not isinstance(data, dict):
        raise ManifestError(f"{path}: must hold one JSON object")
    if "schema" not in data:
        raise ManifestError(f"{path}: schema: is missing: this program reads {schema}")
    if data["schema"] != schema:
        raise ManifestError(f"{path}: schema: is {_short(data['schema'])}, this program reads {schema}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        found = chain(faults_of(error), further(data) if further is not None else ())
        raise ManifestError(*listed((f"{path}: {fault}" for fault in found), f"{path}: has further faults: mend these first")) from error


def schema_of(model: type[BaseModel]) -> str:
    """Return the value that the key `schema` of a model's files must have."""
    return str(get_args(model.model_fields["schema_"].annotation)[0])


def record_text(record: BaseModel, rows: str, **always: object) -> str:
    """Return the JSON of a record without what has its default, but for `always`; each of its list `rows` has a line, at the end."""
    data = record.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    lines = ",\n".join("    " + json.dumps(row) for row in data.pop(rows))
    head = {"schema": data.pop("schema"), "name": data.pop("name"), **always, **data}
    return json.dumps(head, indent=2)[:-2] + f',\n  "{rows}": [\n{lines}\n  ]\n}}\n'


def describe(error: ValidationError, name: FieldName | None = None) -> str:
    """Return the first fault of a pydantic error as `field: what is wrong`, with the count of the other faults."""
    faults = faults_of(error, name)
    return faults[0] + (f" (and {len(faults) - 1} more)" if len(faults) > 1 else "")


def faults_of(error: ValidationError, name: FieldName | None = None, within: tuple[int | str, ...] = ()) -> list[str]:
    """Return the faults of a pydantic error, each as `field: what is wrong`.
    `name`: names the fields; None: as `field_name` does. `within`: the place of what was validated, in the content of the file."""
    places = {fault["loc"][:n] for fault in error.errors() for n in range(len(fault["loc"]))}
    named = [(fault, (name or field_name)((*within, *fault["loc"]))) for fault in error.errors()
             if fault["loc"] not in places]  # a fault of an entry replaces the fault of its list
    return [f"{where}: {said(fault)}" if where else said(fault) for fault, where in named]


def said(fault: Any) -> str:
    """Return what is wrong with the value of a field, from an entry of `ValidationError.errors`."""
    match fault["type"]:
        case "extra_forbidden":
            return "is not a known key"
        case "missing":
            return "is missing"
        case "json_invalid":
            return f"is no JSON ({fault['ctx']['error']})"
        case "value_error":
            return str(fault["ctx"]["error"])
        case "union_tag_invalid":
            return f"{fault['ctx']['discriminator'].strip(chr(39))} is {_short(fault['ctx']['tag'])}, " \
                   f"must be one of {fault['ctx']['expected_tags']}"
        case "too_short":
            return f"has {fault['ctx']['actual_length']} entries, needs {fault['ctx']['min_length']} or more"
        case "too_long":
            return f"has {fault['ctx']['actual_length']} entries, must have {fault['ctx']['max_length']}"
        case "tuple_type":
            return f"is {_short(fault['input'])}: must be a list"
        case "model_type" | "model_attributes_type":
            return f"is {_short(fault['input'])}: must be an object"
        case "union_tag_not_found":
            return f"lacks the key {fault['ctx']['discriminator'].strip(chr(39))}"
        case "string_pattern_mismatch" if prefix := IDENTIFIER.match(fault["ctx"]["pattern"]):
            return f"is {_short(fault['input'])}: give an identifier as the service printed it, which begins with {prefix[1]}"
        case _:
            return f"is {_short(fault['input'])}: {fault['msg'][0].lower()}{fault['msg'][1:]}"


def faults_of_each(data: dict[str, Any], key: str, model: type[BaseModel]) -> Iterator[str]:
    """Yield the faults of every entry of a list in a JSON object, where pydantic stops at the first, as sentences without the file."""
    entries = data.get(key)
    for index, entry in enumerate(entries if isinstance(entries, list) else ()):
        try:
            model.model_validate(entry)
        except ValidationError as error:
            yield from faults_of(error, within=(key, index))


def field_name(location: tuple[int | str, ...]) -> str:
    """Return a field such as `frames[3].light.direction` from a pydantic location, which also names union members after their key."""
    text = ""
    previous: int | str = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part}]"
        elif previous not in ("light", "pattern", "laser", "tof", "projector"):
            text += ("." if text else "") + (part if len(part) <= MOST_SHOWN else f"{part[:MOST_SHOWN]}...")
        previous = part
    return text


def _short(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= MOST_SHOWN else text[: MOST_SHOWN - 3] + "..."


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) > MAX_KEYS:
        raise ValueError(f"an object has more than {MAX_KEYS} keys")
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            raise ValueError(f"key {_short(key)[1:-1]} is given twice in one object")
        result[key] = value
    return result


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")
