"""docs/manifest.md: every field of a capture.json, made from the models; `python -m docs.tools.manifest_page` writes it.

The words of a field are its docstring, its range is that of its type, its unit is the end of its name, and its example is in
`docs.tools.manifest_examples`.
"""

import ast
import inspect
import itertools
import json
import re
import types
from collections.abc import Iterator
from inspect import get_annotations
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from docs.tools.manifest_examples import EXAMPLES
from stage.capture.manifest import Frame, Manifest
from stage.colour.colour_spaces import ColorSpaceName
from stage.files import write_text
from stage.model import Direction, LitRgb, Resolution, Rgb, Strict, Text
from stage.transforms import Transform

PAGE = Path(__file__).parents[2] / "docs" / "manifest.md"
UNITS = {"_m": "metres", "_px": "pixels", "_s": "seconds", "_hz": "hertz", "_rad": "radians"}
"""The unit of a field by the end of its name."""
SPECIAL: tuple[tuple[Any, str], ...] = (
    (Direction, "x, y, z of any length above 0, which is made 1"),
    (LitRgb, "red, green, blue, each 0 or more, not all 0"),
    (Rgb, "red, green, blue, each 0 or more"),
    (Resolution, "width and height, whole numbers, 1 or more"),
    (Transform, "4×4 matrix by rows: a rotation and a translation"),
    (Text, "text"),
    (ColorSpaceName, "a [colour space](colour.md)"),
)
"""The types whose values are not numbers, lists or choices alone, and their words."""
SCALARS: dict[type, str] = {float: "number", int: "whole number", bool: "`true` or `false`", str: "text"}
LONGEST_EXAMPLE = 60
"""The most characters of an example in a table; longer ones stand below it."""
HEADINGS = {"camera": "The camera", "projector": "The projector", "light": "Lights", "pattern": "Patterns", "laser": "Lasers",
            "tof": "Time of flight", "stereo": "Texture seen by several cameras", "other_cameras": "Other cameras"}
"""The sections of the objects, by the key that leads to them."""
HEAD = """# Every field of capture.json

*After reading this page you can look up any field of a manifest: its range, its default and an example.*

*This page is made from the program by `python -m docs.tools.manifest_page`. [capture.md](capture.md) explains what the fields mean \
together.*

The camera frame has x to the right, y up and z towards the viewer. A text has one line and is not blank. A key that is not listed is
an error. The column *if left out* has the value that a missing key stands for; a manifest without a *required* key is refused, and
`null` is the same as leaving out an *optional* one. The lines below a table are examples, each of which is read in a test.
"""


def page() -> str:
    """Return the page."""
    sections = [_section("## The manifest", Manifest), _section("## frames[]", Frame)]
    hints = {**get_type_hints(Manifest, include_extras=True), **get_type_hints(Frame, include_extras=True)}
    for key, heading in HEADINGS.items():
        sections.append(f"## {heading}\n")
        for model in models_of(hints[key]):
            sections.append(_section(f"### `{key}`{_told_by(model)}", model))
            sections += [_section(f"### `{name}`", inner) for name, hint in get_type_hints(model, include_extras=True).items()
                         for inner in models_of(hint)]
    return "\n".join([HEAD, *dict.fromkeys(sections)]).rstrip() + "\n"


def models_of(annotation: Any) -> Iterator[type[Strict]]:
    """Yield the models that a value of a type may be."""
    if isinstance(annotation, type) and issubclass(annotation, Strict):
        yield annotation
    elif get_origin(annotation) is Annotated or get_origin(annotation) in (Union, types.UnionType, tuple):
        for part in get_args(annotation)[:1] if get_origin(annotation) is Annotated else get_args(annotation):
            yield from models_of(part)


def fields_of(model: type[BaseModel]) -> Iterator[tuple[str, Any, str, FieldInfo]]:
    """Yield the key, the type, the docstring (empty where there is none) and the declaration of every field of a model.

    First is what tells the model from others at its place, then come its own fields, then those of its bases.
    """
    hints = get_type_hints(model, include_extras=True)
    docs: dict[str, str] = {}
    own: dict[str, None] = dict.fromkeys(name for name in ("type", "code") if name in model.model_fields)
    for cls in model.__mro__:
        if cls is not BaseModel and issubclass(cls, BaseModel):
            docs = {**_docstrings(cls), **docs}
            own |= dict.fromkeys(name for name in get_annotations(cls) if name in model.model_fields)
    for name in own:
        field = model.model_fields[name]
        yield field.alias or name, hints[name], docs.get(name, ""), field


def _section(heading: str, model: type[Strict]) -> str:
    """Return a heading, what a model is, the table of its fields, and its examples."""
    lines = [f"{heading}\n", f"{inspect.cleandoc(model.__doc__ or '')}\n", "| key | value | if left out | meaning | example |",
             "|---|---|---|---|---|"]
    examples = EXAMPLES[model]
    for key, hint, words, field in fields_of(model):
        unit = next((f", {unit}" for end, unit in UNITS.items() if key.endswith(end)), "")
        default = "required" if field.is_required() else "optional" if field.default is None else f"`{json.dumps(field.default)}`"
        meaning = re.sub(r"([.;]) None: ", lambda found: found[1] + (" Without it: " if found[1] == "." else " without it: "),
                         " ".join(words.split()))
        example = json.dumps(next(each[key] for each in examples if key in each), ensure_ascii=False)
        cells = f"`{key}`", _words(hint) + unit, default, meaning, f"`{example}`" if len(example) <= LONGEST_EXAMPLE else "below"
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join([*lines, "", "```json", *(json.dumps(example, ensure_ascii=False) for example in examples), "```\n"])


def _told_by(model: type[Strict]) -> str:
    """Return what tells a model from others at its place, such as `type` distant."""
    for name, hint in get_type_hints(model).items():
        if name in ("type", "code") and get_origin(hint) is Literal:
            return f": `{name}` " + ", ".join(f"`{value}`" for value in get_args(hint))
    return " without lens and place" if model.__name__.startswith("Uncalibrated") else ""


def _words(hint: Any, bounds: str = "") -> str:
    """Return what a value of a type may be, within bounds."""
    origin, parts = get_origin(hint), get_args(hint)
    if (known := next((words for kind, words in SPECIAL if hint == kind), None)) is not None:
        return known
    if origin is Literal:
        return ", ".join(f"`{json.dumps(value)}`" for value in parts)
    if origin is Annotated:
        return _words(parts[0], _bounds(parts[1:]))
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_words(part) for part in parts if part is not types.NoneType))
    if origin is tuple and parts[-1] is Ellipsis:
        return f"a list{bounds.replace(',', ' of', 1)}; each: {_words(parts[0])}"
    if origin is tuple:
        return f"{len(parts)} numbers{_words(parts[0]).removeprefix('number')}" if _words(parts[0]).startswith("number") else \
            f"{len(parts)} times: {_words(parts[0])}"
    return "an object" if list(models_of(hint)) else SCALARS[hint] + bounds


def _bounds(constraints: tuple[Any, ...]) -> str:
    """Return the range that constraints allow, as words after a comma."""
    found = ""
    for each in [each for constraint in constraints for each in getattr(constraint, "metadata", (constraint,))]:
        for name, words in (("gt", "above {:g}"), ("ge", "{:.6g} or more"), ("le", "{:.6g} or less"), ("min_length", "{} or more")):
            if (limit := getattr(each, name, None)) is not None:
                found += ", " + words.format(limit)
    return found


def _docstrings(model: type) -> dict[str, str]:
    """Return the text below each field of a class, by the name of the field."""
    definition = ast.parse(inspect.getsource(model)).body[0]
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, text in itertools.pairwise(definition.body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr) \
                and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str):
            found[field.target.id] = text.value.value
    return found


if __name__ == "__main__":
    write_text(PAGE, page())
