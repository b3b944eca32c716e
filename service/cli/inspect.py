"""relit inspect: look at a USD or glTF asset as a technical director does."""

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import typer

from service.cli.request_commands import local_command
from service.requests.export import InspectRequest

if TYPE_CHECKING:
    from service.gltf.inspect import GlbInspection
    from service.usd.inspect import Inspection
    from service.usd.inspect_geometry import PrimvarFacts
    from service.usd.inspect_looks import MaterialFacts, TextureFacts

LONGEST_TEXT = 100
"""Characters of a text of the provenance that are printed; --json has all."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "inspect", _inspect)


def _inspect(request: InspectRequest) -> None:
    from service.asset.errors import AssetError

    found: Inspection | GlbInspection
    if request.asset.suffix.lower() == ".glb":
        from service.gltf.inspect import inspect_glb

        found = inspect_glb(request.asset)
        lines = _glb_lines(found)
    else:
        from service.usd.inspect import inspect_asset

        found = inspect_asset(request.asset)
        lines = _lines(found)
    if request.as_json:
        print(json.dumps(dataclasses.asdict(found), ensure_ascii=False, indent=2))
    else:
        for name, value in lines:
            print(f"{name:<12} {value}")
    if found.errors:
        others = f" (and {len(found.errors) - 1} more)" if len(found.errors) > 1 else ""
        raise AssetError(f"{request.asset}: {found.errors[0]}{others}")


def _lines(found: "Inspection") -> Iterator[tuple[str, str]]:
    """Yield what is printed, as names and values."""
    yield "asset", f"{found.file}, {_bytes(found.size_bytes)}"
    for layer in found.layers:
        yield "layer", layer
    yield "prim", f"{found.default_prim or 'no default prim'}, {f'kind {found.kind}' if found.kind else 'no kind'}"
    repeated = [key for key in found.asset_info if found.asset_info[key] == found.provenance.get(key)]
    yield "assetInfo", ", ".join(f"{key} {value}" for key, value in found.asset_info.items() if key not in repeated) or "none"
    yield "unit", f"metersPerUnit {found.meters_per_unit:g}, upAxis {found.up_axis}"
    for key, value in found.notes.items():
        yield "note", f"{key} {value}"
    if found.time_codes is not None:
        yield "time", "time codes {:g} to {:g}, timeCodesPerSecond {:g}".format(*found.time_codes)
    yield "extent", _extent(found.extent_m)
    for name, variants in found.variants.items():
        yield "variants", f"{name}: {', '.join(f'[{each}]' if each == found.selections.get(name) else each for each in variants)}"
    for variant in found.meshes:
        where = f"{variant} " if variant else ""
        for mesh in found.meshes[variant]:
            yield "mesh", (f"{where}{mesh.path}, purpose {mesh.purpose}: {mesh.vertices} vertices, {mesh.faces} faces, "
                           f"{mesh.pieces} pieces, {mesh.boundary_edges} boundary edges, {mesh.non_manifold_edges} non-manifold edges, "
                           f"{mesh.holes} holes")
            yield from _primvars(mesh.primvars)
        for cloud in found.points[variant]:
            width = "no width" if cloud.width_m is None else "widths {:.3g} to {:.3g} m".format(*cloud.width_m)
            yield "points", f"{where}{cloud.path}, purpose {cloud.purpose}: {cloud.points} points, {width}"
            yield from _primvars(cloud.primvars)
    for variant, materials in found.materials.items():
        for material in materials:
            yield from _material(f"{variant} " if variant else "", material)
    for variant, lights in found.lights.items():
        for kind in dict.fromkeys(light.rpartition(" ")[2] for light in lights):
            paths = [light.removesuffix(f" {kind}") for light in lights if light.endswith(f" {kind}")]
            named = paths[0] if len(paths) == 1 else f"{len(paths)} lights, {paths[0]} to {paths[-1]}"
            yield "light", f"{variant} {named} {kind}".strip()
    for camera in found.cameras:
        yield "camera", f"{camera.path}, {camera.projection}, {camera.framing}"
    yield from _provenance(found.provenance)
    yield "validation", f"{found.validators} validators on each variant: {len(found.errors)} errors, {len(found.warnings)} warnings"
    for sentence in found.warnings:
        yield "warning", sentence
    for sentence in found.errors:
        yield "wrong", sentence


def _glb_lines(found: "GlbInspection") -> Iterator[tuple[str, str]]:
    """Yield what is printed of a .glb, as names and values."""
    yield "asset", f"{found.file}, {_bytes(found.size_bytes)}"
    yield "assetInfo", ", ".join(f"{key} {value}" for key, value in found.asset_info.items()) or "none"
    yield "extensions", ", ".join(found.extensions) or "none"
    yield "extent", _extent(found.extent_m)
    for primitive in found.primitives:
        yield "mesh", (f"{primitive.mesh}, {primitive.mode}: {primitive.vertices} vertices, {primitive.faces} faces, "
                       f"{', '.join(primitive.attributes)}")
    for material in found.materials:
        yield "material", material.name
        for name, image in material.images.items():
            size = "no PNG" if image.width is None else f"{image.width}×{image.height}, {image.channels} × {image.depth} bits"
            yield "  texture", f"{name}: {image.name}, {size}, {_bytes(image.size_bytes)}"
        for name, value in material.values.items():
            yield "  value", f"{name}: {value}"
    for camera in found.cameras:
        yield "camera", camera
    yield from _provenance(found.provenance)
    for sentence in found.errors:
        yield "wrong", sentence


def _extent(extent_m: tuple[Sequence[float], Sequence[float]] | None) -> str:
    if extent_m is None:
        return "nothing"
    low, high = extent_m
    size = " × ".join(f"{top - bottom:.4g}" for bottom, top in zip(low, high, strict=True))
    return f"{size} m, from {_vector(low)} to {_vector(high)}"


def _provenance(provenance: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    for key, value in provenance.items():
        yield "provenance", f"{key} {value if len(value) <= LONGEST_TEXT else value[:LONGEST_TEXT] + ' …'}"


def _primvars(primvars: "Sequence[PrimvarFacts]") -> Iterator[tuple[str, str]]:
    for primvar in primvars:
        values = "" if primvar.low is None or primvar.high is None else f", {_vector(primvar.low)} to {_vector(primvar.high)}"
        yield "  primvar", f"{primvar.name}, {primvar.interpolation}, {primvar.count} values{values}"


def _material(where: str, material: "MaterialFacts") -> Iterator[tuple[str, str]]:
    for surface in material.surfaces:
        workflow = f", {surface.workflow} workflow" if surface.workflow else ""
        yield "material", f"{where}{material.path}, {surface.context}: {surface.shader}{workflow}"
        for entry in surface.inputs:
            if entry.texture is not None:
                yield "  texture", f"{entry.name}: {_texture(entry.texture)}"
            elif entry.value is not None:
                yield "  value", f"{entry.name}: {entry.value}"


def _texture(texture: "TextureFacts") -> str:
    if not texture.found or texture.size_bytes is None:
        return f"{texture.file}, missing"
    image = "no image" if texture.width is None else f"{texture.width}×{texture.height}, {texture.channels} × {texture.depth}"
    return f"{texture.file}, {image}, {texture.color_space or 'no colour space'}, {_bytes(texture.size_bytes)}"


def _vector(values: Sequence[float]) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"


def _bytes(count: int) -> str:
    return f"{count / 1e6:.3g} MB" if count >= 1e6 else f"{count / 1e3:.3g} kB"
