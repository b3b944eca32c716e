"""relit export, blender-extension, inspect, basis, publish and join: assets, how they reach Blender and what they hold, coefficient images
and web pages of a capture, and maps joined with a depth."""

import json
from collections.abc import Iterator
from itertools import groupby
from typing import TYPE_CHECKING, Any

import typer

from service.cli.printing import print_lines, print_warnings
from service.cli.progress import ProgressBar, ProgressOption, ProgressStyle, with_bar
from service.cli.request_commands import local_command, product_command
from service.requests.basis import BasisRequest
from service.requests.export import BlenderExtensionRequest, ExportRequest, InspectRequest
from service.requests.publish import PublishRequest
from service.requests.solve import JoinRequest

if TYPE_CHECKING:
    from service.asset.content.surface import Inspection, Part

LONGEST_TEXT = 100
"""Characters of a text of the provenance that relit inspect prints; --json has all."""


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "export", _export)
    product_command(app, "blender-extension", BlenderExtensionRequest, "service.blender.package:pack",
                    lambda path: print(f"extension {path}"))
    local_command(app, "inspect", _inspect)
    product_command(app, "basis", BasisRequest, "service.basis.basis:make_basis", _basis)
    product_command(app, "publish", PublishRequest, "service.publish.publish:publish", _publish)
    product_command(app, "join", JoinRequest, "service.joining.join:join", _join)


def _export(request: ExportRequest, progress: ProgressOption = ProgressStyle.BAR) -> None:
    from service.export.export import export

    exported = with_bar(export, request, progress)
    print(f"asset    {exported.path}")
    for layer in exported.lights:
        print(f"lights   {layer}")
    for name, (vertices, faces) in exported.sizes.items():
        print(f"{name:<8} {vertices} vertices, {faces} faces")
    print_warnings(exported.warnings)


def _inspect(request: InspectRequest) -> None:
    from service.errors import AssetError
    from service.export.writers import INSPECTED

    path = request.asset
    if not path.is_file():
        raise AssetError(f"{path} is {'a folder' if path.is_dir() else 'not there'}: give the asset, a file")
    inspect = INSPECTED.get(path.suffix.lower())
    if inspect is None:
        raise AssetError(f"{path}: relit inspect reads {', '.join(INSPECTED)}")
    with ProgressBar() as bar:
        bar.stage("inspect", 1)
        found = inspect(path)
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
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(each)}" for name, each in value.items()) or "none"
    if isinstance(value, list):
        return f"({', '.join(map(_text, value))})"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _publish(result: Any, request: PublishRequest) -> None:
    print(f"{request.kind:<8} {result.path}")
    print(f"files    {result.files}, {result.size / 1e6:.3g} MB")
    if result.left_out:
        print(f"lights   {result.left_out} are not in front of the object, and left out")
    if result.near_lights:
        print(f"lights   {result.near_lights} near lights are taken as distant, as the object's centre sees them")
    if result.levels_rms is not None:
        print(f"error    {result.levels_rms:.2g} of 255 display levels from the captured images (RMS), before JPEG")


def _join(result: Any) -> None:
    pixels, sigma = result.facts["pixels"], result.facts["sigma_m"]
    print_lines(maps=result.maps_path, report=result.report_path)
    print(f"pixels   {pixels['solved']} solved of {pixels['mask']}, {pixels['with_depth']} with a depth")
    print(f"sigma    {sigma['joined_median'] * 1000:.3g} mm, of the depth alone {sigma['depth_median'] * 1000:.3g} mm")


def _basis(result: Any) -> None:
    print_lines(basis=result.path, facts=result.facts_path)
    shown = "" if result.levels_rms is None else f" of what is shown, {result.levels_rms:.1f} of 255"
    print(f"error    {100 * result.relative_rms:.3g} % RMS{shown}: {result.terms} coefficients a channel, {result.lights} lights, "
          f"{result.pixels} pixels")
    if result.key_lights_rms is not None:
        print(f"error    {100 * result.key_lights_rms:.3g} % RMS of pictures under lights from between the captured ones")
    if result.left_out:
        print(f"lights   {result.left_out} are not in front of the object and are left out")
    if result.near_lights:
        print(f"lights   {result.near_lights} near lights are taken as distant, as the object's centre sees them")
