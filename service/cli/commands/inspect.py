"""relit inspect: look at a USD or glTF asset as a technical director does."""

import json
from collections.abc import Iterator
from itertools import groupby
from typing import TYPE_CHECKING, Any

import typer

from service.cli.request_commands import local_command
from service.requests.export import InspectRequest

if TYPE_CHECKING:
    from service.asset.content.inspection import Inspection, Part

LONGEST_TEXT = 100
"""Characters of a text of the provenance that are printed; --json has all."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "inspect", _inspect)


def _inspect(request: InspectRequest) -> None:
    from service.errors import AssetError

    path = request.asset
    if not path.is_file():
        raise AssetError(f"{path} is {'a folder' if path.is_dir() else 'not there'}: give the asset, a file")
    if path.suffix.lower() == ".glb":
        from service.asset.gltf.inspect import inspect_glb as inspect_asset
    else:
        from service.asset.usd.inspect import inspect_asset
    found = inspect_asset(path)
    if request.as_json:
        plain = found._asdict() | {"parts": [part._asdict() for part in found.parts]}
        print(json.dumps(plain, ensure_ascii=False, indent=2, default=str))
    else:
        for name, value in _lines(found):
            print(f"{name:<12} {value}")
    if found.errors:
        others = f" (and {len(found.errors) - 1} more)" if len(found.errors) > 1 else ""
        raise AssetError(f"{path}: {found.errors[0]}{others}")


def _lines(found: "Inspection") -> Iterator[tuple[str, str]]:
    """Yield what is printed, as names and values."""
    size = found.size_bytes
    yield "asset", f"{found.file}, {f'{size / 1e6:.3g} MB' if size >= 1e6 else f'{size / 1e3:.3g} kB'}"
    for name, value in found.facts.items():
        yield name, _text(value)
    for _, alike in groupby(found.parts, key=lambda part: (part.kind, part.variant, part.facts if part.kind == "light" else part.name)):
        parts: list[Part] = list(alike)
        names = parts[0].name if len(parts) == 1 else f"{parts[0].name} and {len(parts) - 1} more"
        yield parts[0].kind, f"{names}{f' [{parts[0].variant}]' if parts[0].variant else ''}: {_text(parts[0].facts)}"
    for key, text in found.provenance.items():
        yield "provenance", f"{key} {text if len(text) <= LONGEST_TEXT else text[:LONGEST_TEXT] + ' …'}"
    for sentence in found.warnings:
        yield "warning", sentence
    for sentence in found.errors:
        yield "wrong", sentence
    yield "found", f"{len(found.errors)} errors, {len(found.warnings)} warnings"


def _text(value: Any) -> str:
    """Return a fact in a line."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(each)}" for name, each in value.items()) or "none"
    if isinstance(value, list):
        return f"({', '.join(map(_text, value))})"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
