"""Solved maps as an asset has them, whatever its format, with their camera; reports of writers, and findings of relit inspect."""

import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import OpenImageIO as oiio

from service.asset.content.mesh import SurfaceMesh, height_mesh
from service.asset.content.metallic import MetallicLook, metallic_look
from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps

ORTHOGRAPHIC_CLEARANCE = 0.5
"""Distance of an orthographic camera from the surface, in image widths; its image does not depend on it."""


class Surface(NamedTuple):
    """A solved surface with its metallic look."""

    mesh: SurfaceMesh
    look: MetallicLook | None  # None: the maps have no reflectance
    provenance: dict[str, str]
    unit_m: float  # metres of a unit of the mesh


class AssetReport(NamedTuple):
    """The files and the sizes of an asset, and what its user should know of it."""

    path: Path
    sizes: dict[str, tuple[int, int]]  # vertices and faces of each mesh by its name; that of the full one is mesh
    step: int  # every step-th pixel in both directions carries a vertex
    clipped_pixels: dict[str, int]  # texture → pixels that did not fit into 0…1
    warnings: tuple[str, ...]  # sentences
    textures: tuple[Path, ...] = ()  # files beside it, with the MaterialX document last; empty where the asset holds them
    lights: tuple[Path, ...] = ()  # layers beside it


def surface_of(maps: SurfaceMaps) -> Surface:
    """Return solved maps as a mesh with its look."""
    look = metallic_look(maps) if maps.diffuse_albedo is not None else None
    provenance = {**maps.provenance, "relit:color_space": maps.color_space, **(look.provenance if look is not None else {})}
    return Surface(height_mesh(maps), look, provenance, unit_in_metres(maps.camera))


class View(NamedTuple):
    """The place of a camera that looks along -z, in units of the height map."""

    z: float  # camera-frame z
    near: float  # distance of the near clipping plane
    far: float  # distance of the far one


def view_of(camera: Camera, extent: np.ndarray) -> View:
    """Return where the camera stands, and a clipping range twice as deep as the surface's bounding box [2, 3], camera frame."""
    farthest, nearest = float(extent[0, 2]), float(extent[1, 2])
    if camera.projection == "perspective":
        return View(0.0, -nearest / 2, -farthest * 2)
    clearance = ORTHOGRAPHIC_CLEARANCE * camera.width * (camera.pixel_size_m or 1.0)
    return View(nearest + clearance, clearance / 2, 2 * (clearance + nearest - farthest))


UNIT_WITHOUT_SCALE_M = 0.001
"""Metres of a pixel where the capture has no scale, so that the asset has a visible size."""

SCALE_NOTE = "unknown: the capture gives no scale, so one pixel is taken as one millimetre"


def unit_in_metres(camera: Camera) -> float:
    """Return the metres of a unit of the height map: 1, or that of a pixel where the capture has no scale."""
    return 1.0 if camera.metric else UNIT_WITHOUT_SCALE_M


LENGTH_TOLERANCE = 0.01
"""The largest deviation of the length of a normal from 1: more than halves and bytes round."""
NUMBERS = re.compile(r":(specular_roughness|roughness|metallic|base_metalness|occlusion|opacity|displacement|clearcoat|geometry_normal)$")
"""Inputs of materials that take numbers, as the names of textures end with them; OpenUSD's validators look at the input normal."""
COLOURS = re.compile(r":(diffuseColor|emissiveColor|specularColor|base_color)$")
"""Inputs of materials that take colours."""
READABLE = (".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tif", ".tiff")
"""Images that can be read unless they are damaged."""


class Part(NamedTuple):
    """One row of the table of what an asset holds."""

    kind: str  # mesh, points, material, texture, light or camera
    name: str  # its path or name, of a texture with the input that reads it
    variant: str  # set=variant, where it is not there with the first selections; else empty
    facts: Mapping[str, Any]


class Inspection(NamedTuple):
    """Contents and faults of an asset."""

    file: str
    size_bytes: int  # with all files that it refers to
    facts: dict[str, Any]  # what holds for the asset as a whole
    parts: tuple[Part, ...]
    provenance: dict[str, str]
    warnings: tuple[str, ...]
    errors: tuple[str, ...]


def image_facts(data: bytes, name: str) -> dict[str, Any]:
    """Return the size of an image and the type of its values, or its bytes alone where it cannot be read; `damaged`: it should be."""
    with tempfile.NamedTemporaryFile(suffix=PurePosixPath(name).suffix) as file:
        file.write(data)
        file.flush()
        image = oiio.ImageInput.open(file.name)
    damaged = {"damaged": True} if PurePosixPath(name).suffix.lower() in READABLE else {}
    if image is None:
        oiio.geterror()  # else OpenImageIO prints it at the end of the program
        return {"bytes": len(data)} | damaged
    spec = image.spec()
    whole = image.read_image(oiio.UINT8) is not None
    if not whole:
        image.geterror()
    image.close()
    return {"bytes": len(data), "resolution": [spec.width, spec.height], "channels": spec.nchannels, "depth": str(spec.format),
            **({} if whole else damaged)}


def length_fault(vectors: np.ndarray) -> str | None:
    """Return how many of some vectors [n, 3], which should be directions, are not of length 1, or None where all are."""
    lengths = np.linalg.norm(np.asarray(vectors, np.float64), axis=1)
    wrong = lengths[np.isfinite(lengths) & (abs(lengths - 1) > LENGTH_TOLERANCE)]
    if not len(wrong):
        return None
    return f"{len(wrong)} of its {len(lengths)} values are not of length 1 but from {wrong.min():.4g} to {wrong.max():.4g} long"


def texture_doubts(parts: Iterable[Part]) -> Iterator[str]:
    """Yield a sentence for each texture of a USD asset whose values are read as if they were encoded for a display though they are numbers,
    or the other way round: `auto` takes images of 8 bits with three or four channels for sRGB (UsdUVTexture)."""
    for part in parts:
        space = str(part.facts.get("color_space") or "").lower()
        bytes_of_colour = part.facts.get("depth") == "uint8" and part.facts.get("channels", 0) >= 3
        file = part.facts.get("file")
        if part.kind == "texture" and NUMBERS.search(part.name) and ("srgb" in space or (space == "auto" and bytes_of_colour)):
            yield f"{part.name}: {file} is read as sRGB (its colour space is {space}), and this input takes numbers: set it to raw"
        elif part.kind == "texture" and COLOURS.search(part.name) and space == "raw" and bytes_of_colour:
            yield f"{part.name}: {file} is read as raw, and colours of 8 bits are mostly sRGB, then shown too bright: set it to sRGB"


def texture_faults(parts: Iterable[Part]) -> Iterator[str]:
    """Yield a sentence for each texture that is damaged or names no file."""
    for part in parts:
        if part.kind == "texture" and part.facts.get("damaged"):
            yield f"{part.name}: {part.facts['file']} is no image that can be read, or a damaged one"
        elif part.kind == "texture" and part.facts.get("missing") and not part.facts["file"]:
            yield f"{part.name}: the texture names no file"


USUAL_M = (1e-3, 100.0)
"""Largest sides, metres, between which an asset of meshes needs no question: objects of a stage are a few millimetres to some metres large,
and a wrong unit makes them a hundred or a thousand times as large or small."""


def size_doubts(extent_m: np.ndarray | None, unit: str) -> list[str]:
    """Return the sentence about an asset of meshes whose size is not that of an object; `extent_m`: its bounding box [2, 3], None: none;
    `unit`: where the asset says its unit."""
    side = 0.0 if extent_m is None else float(np.ptp(extent_m, axis=0).max())
    if side == 0 or not np.isfinite(side) or USUAL_M[0] <= side <= USUAL_M[1]:
        return []
    return [f"the asset is {side:.3g} m large: {unit}: if it should not be, scale it or correct that"]
