"""Writes solved maps or a measured depth as binary glTF: one .glb file with a mesh or points, their material and the camera."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib as gltf
from pygltflib import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, POINTS, TRIANGLES, Asset, Attributes, Mesh, Node, Primitive, Scene

from service import __version__
from service.asset.content.depth import UNCERTAINTY, colour_image, colour_warnings, depth_mesh, measured_points, mesh_warnings, photographed
from service.asset.content.mesh import SurfaceMesh
from service.asset.content.metallic import GLASS_IOR, MetallicLook, loss_warnings
from service.asset.content.surface import SCALE_NOTE, AssetReport, surface_of, view_of
from service.asset.content.tangent import vertex_tangents
from service.asset.content.textures import BLEED_TEXELS, DATA_SPACE, DISPLAY_SPACE, Texture, bleed, encode, encode_normals, side_by_side
from service.asset.gltf.container import Glb, writing_glb
from service.errors import AssetError
from service.reporting.progress import Progress, Timings
from service.requests.export import FIRST_VERSION, Geometry, TextureFormat
from stage.capture.camera import Camera
from stage.formats.images import write_png
from stage.formats.ply import PointCloud
from stage.results.depth_maps import DepthMaps
from stage.results.maps import SurfaceMaps
from stage.results.result_metadata import result_metadata

GLTF_VERSION = "2.0"
FREE_OFFSET_PX = 0.5
"""Distance in pixels of the principal point from the image centre beyond which the camera is said to differ from the capturing one."""
LARGEST_SHORT_COUNT = 65535
"""Vertices that indices of 16 bits can number: the largest index, 65535, is reserved for restarting a primitive (3.7.2.1)."""
BASE_COLOR, METALLIC_ROUGHNESS, NORMAL = "base_color", "metallic_roughness", "normal"
"""The images of a material."""
NEUTRAL_GREY = 0.18
"""Base colour where the maps have no albedo: the default of UsdPreviewSurface, so that both formats look alike."""


def write_asset(maps: SurfaceMaps, path: str | Path, *, name: str, version: str = FIRST_VERSION,
                textures: TextureFormat = TextureFormat.PNG16, progress: Progress | None = None) -> AssetReport:
    """Write solved maps as a .glb file, whole or not at all.
    `name`: free text; the root node, the mesh and the material are named after it. `textures`: the bits of normals, roughness and metallic;
    colours have 8. Raises AssetError for EXR textures, maps without a height layer or without a face, a colour space that is not known, or
    more than the 4 GiB that a .glb can hold. Raises StorageError if the disk refuses; what was there before is left as it was."""
    target = Path(path)
    check_textures(target, textures)
    timings = Timings(progress)
    timings.stage("mesh", 1)
    mesh, look, provenance, unit_m = surface_of(maps)
    with writing_glb(target) as (glb, folder):
        written = write_textures(maps, mesh, folder, look=look, storage=textures, progress=timings)
        timings.stage("write", 1)
        material = add_material(glb, written, folder, ior=look.ior if look is not None else GLASS_IOR, name=name)
        surface = add_surface(glb, mesh, unit_m=unit_m, material=material, textured=bool(written), with_tangents=NORMAL in written)
        add_scene(glb, surface, maps.camera, mesh.extent, provenance, name=name, file_name=target.name, version=version, unit_m=unit_m)
    return AssetReport(target, {"mesh": (len(mesh.points), 2 * len(mesh.quads) + len(mesh.triangles))}, mesh.step,
                       {name: texture.clipped_pixels for name, texture in written.items()},
                       (*camera_warnings(maps.camera), *(loss_warnings(look) if look is not None else ())))


def write_depth(
    maps: DepthMaps,
    cloud: PointCloud | None,  # what points.ply holds, or None
    path: str | Path, *,
    name: str,  # free text; the root node and the material are named after it
    geometry: Geometry = Geometry.MESH,  # what the asset is made of; glTF has no variants for both
    version: str = FIRST_VERSION,  # of the asset, kept with the file's name in the extras of `asset`
    textures: TextureFormat = TextureFormat.PNG16,
    progress: Progress | None = None,
) -> tuple[str, ...]:
    """Write a depth as a .glb file, whole or not at all, and return sentences on what the asset lacks.
    Raises AssetError for EXR textures, no point, no face for a mesh, a cloud that is not one of this depth, or more than 4 GiB. Raises
    StorageError if the disk refuses; what was there before is left as it was."""
    target = Path(path)
    check_textures(target, textures)
    points = measured_points(maps, cloud)
    mesh = depth_mesh(maps) if geometry is Geometry.MESH else None
    with writing_glb(target) as (glb, folder):
        if mesh is None:
            material = add_unlit_material(glb, name=name, coloured=points.colours is not None)
            primitive, extent = add_points(glb, points.points, points.colours, material=material), points.extent
            _add_uncertainty(glb, primitive, maps, points.rows, points.cols)
        else:
            colours = colour_image(points, maps.mask)
            written = {}
            if colours is not None:
                seen, look = photographed(maps, colours)
                written = write_textures(seen, mesh, folder, look=look, storage=textures, progress=progress)
            material = add_material(glb, written, folder, name=name)
            primitive = add_surface(glb, mesh, unit_m=1.0, material=material, textured=bool(written), with_tangents=False)
            extent = mesh.extent
            _add_uncertainty(glb, primitive, maps, mesh.rows, mesh.cols)
        add_scene(glb, primitive, maps.camera, extent, maps.provenance, name=name, file_name=target.name, version=version)
    told = mesh_warnings(mesh, maps) if mesh is not None else ()
    return (*colour_warnings(points), *told, *camera_warnings(maps.camera))


def _add_uncertainty(glb: Glb, primitive: Primitive, maps: DepthMaps, rows: np.ndarray, cols: np.ndarray) -> None:
    """Add standard deviation (_SIGMA, metres) and confidence (_CONFIDENCE) of each vertex, where the depth has them; 0: unknown."""
    for layer in UNCERTAINTY:
        values = getattr(maps, layer)
        if values is not None:
            add_attribute(glb, primitive, layer, values[rows, cols])


# The scene of a .glb: a root node that stands in the world, and below it what was captured, a mesh or points, its material and the camera.
#
# Source: glTF 2.0 Specification, 3.5 "Scenes", 3.7.2 "Meshes", 3.3 "Asset" and 3.9 "Materials"; KHR_materials_ior; KHR_materials_specular.

def add_surface(glb: Glb, mesh: SurfaceMesh, *, unit_m: float, material: int, textured: bool, with_tangents: bool) -> Primitive:
    """Add the arrays of a mesh and return the primitive that uses them.
    `unit_m`: metres of a unit of the mesh; glTF has no other unit than the metre. `with_tangents`: write tangents, which only a normal map
    needs.

    Convention:
        The texture origin of glTF is the upper left corner, so v = 1 - t. The bitangent that a renderer makes, cross(normal, tangent) · w,
        must point to the upper edge of the image (3.7.2.1 and 3.9.3), which is N × T, so w = 1.
    """
    attributes = Attributes(POSITION=glb.add_array(mesh.points * np.float32(unit_m), target=ARRAY_BUFFER, bounds=True),
                            NORMAL=glb.add_array(mesh.normals, target=ARRAY_BUFFER))
    if textured:
        attributes.TEXCOORD_0 = glb.add_array(np.stack([mesh.st[:, 0], 1 - mesh.st[:, 1]], axis=-1), target=ARRAY_BUFFER)
    if with_tangents:
        tangents = np.ones((len(mesh.points), 4), dtype=np.float32)
        tangents[:, :3] = vertex_tangents(mesh)
        attributes.TANGENT = glb.add_array(tangents, target=ARRAY_BUFFER)
    indices = triangles_of(mesh)
    if len(mesh.points) <= LARGEST_SHORT_COUNT:
        indices = indices.astype(np.uint16)
    return Primitive(attributes=attributes, indices=glb.add_array(indices.ravel(), target=ELEMENT_ARRAY_BUFFER), mode=TRIANGLES,
                     material=material)


def add_points(glb: Glb, points: np.ndarray, colours: np.ndarray | None, *, material: int) -> Primitive:
    """Add points [n, 3], metres, and return the primitive that uses them; colours are scene-linear Rec.709, and are clipped to 0…1."""
    attributes = Attributes(POSITION=glb.add_array(points, target=ARRAY_BUFFER, bounds=True))
    if colours is not None:
        attributes.COLOR_0 = glb.add_array(np.clip(colours, 0, 1), target=ARRAY_BUFFER)
    return Primitive(attributes=attributes, mode=POINTS, material=material)


def add_attribute(glb: Glb, primitive: Primitive, name: str, values: np.ndarray) -> None:
    """Add values [n] of the vertices or points of a primitive, which other programs do not know by themselves; not finite ones become 0.

    The name is written in capitals behind an underscore, as the specification asks (3.7.2.1).
    """
    finite = np.where(np.isfinite(values), values, 0).astype(np.float32)
    setattr(primitive.attributes, f"_{name.upper()}", glb.add_array(finite, target=ARRAY_BUFFER))


def triangles_of(mesh: SurfaceMesh) -> np.ndarray:
    """Return the faces as triangles, [2 Q + T, 3] uint32: quads are cut from their first corner, as renderers of USD cut them."""
    halves = mesh.quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return np.concatenate([halves, mesh.triangles]).astype(np.uint32)


def camera_and_place(camera: Camera, extent: np.ndarray, *, unit_m: float) -> tuple[gltf.Camera, list[float]]:
    """Return the camera, and where it stands in the camera frame, in metres, before a surface in a box [2, 3] in units of the height map.

    Convention:
        A camera of glTF looks along -z with +y up, as the camera frame has it. An orthographic one is moved sideways by what its principal
        point is off the centre; a perspective one has no place for that (`principal_offset`), nor for lens distortion.
    """
    view = view_of(camera, extent)
    near, far = view.near * unit_m, view.far * unit_m
    if camera.projection == "perspective":
        assert camera.focal_px is not None  # the camera's validator saw to it
        half_width, half_height = camera.width / 2 / camera.focal_px[0], camera.height / 2 / camera.focal_px[1]
        lens = gltf.Perspective(yfov=2 * math.atan(half_height), aspectRatio=half_width / half_height, znear=near, zfar=far)
        return gltf.Camera(type="perspective", perspective=lens, name="Camera"), [0.0, 0.0, 0.0]
    pixel = (camera.pixel_size_m or 1.0) * unit_m
    box = gltf.Orthographic(xmag=camera.width * pixel / 2, ymag=camera.height * pixel / 2, znear=near, zfar=far)
    right, down = principal_offset(camera)
    return gltf.Camera(type="orthographic", orthographic=box, name="Camera"), [-right * pixel, down * pixel, view.z * unit_m]


def principal_offset(camera: Camera) -> tuple[float, float]:
    """Return how far the principal point lies to the right of the image centre and below it, in pixels."""
    cu, cv = camera.principal_point
    return cu - camera.width / 2, cv - camera.height / 2


def camera_warnings(camera: Camera) -> list[str]:
    """Return a sentence for what a camera of glTF cannot hold."""
    if camera.projection == "orthographic":
        return []
    right, down = principal_offset(camera)
    if max(abs(right), abs(down)) <= FREE_OFFSET_PX:
        return []
    return [f"camera: its principal point is {right:+.1f} px to the right of the image centre and {down:+.1f} px below it, which a "
            "camera of glTF cannot hold: it shows the asset shifted by as much; a .usdc keeps it"]


def add_scene(glb: Glb, primitive: Primitive, camera: Camera, extent: np.ndarray, provenance: Mapping[str, str], *, name: str,
              file_name: str, version: str, unit_m: float = 1.0) -> None:
    """Add the scene, and the metadata of the asset.

    Args:
        extent: [2, 3] bounding box of the primitive, camera frame, in units of the height map.
        provenance: kept in the extras of the root node, with the camera.
        file_name: of the asset, its identifier.
        unit_m: metres of a unit of the height map.

    Convention:
        The camera frame of Relit has the axes of glTF: +x right, +y up, +z towards the viewer. world_from_camera, where the capture gives
        it, is the matrix of the root node, column by column.
    """
    document = glb.document
    document.asset = Asset(version=GLTF_VERSION, generator=f"Relit {__version__}", extras={"identifier": file_name, "version": version})
    extras = result_metadata(camera, provenance)
    if unit_m != 1:
        extras["relit:scale"] = SCALE_NOTE
    root = Node(name=name, children=[1, 2], extras=dict(sorted(extras.items())))
    if camera.world_from_camera is not None and not np.array_equal(camera.world_from_camera, np.eye(4)):
        root.matrix = np.array(camera.world_from_camera, dtype=np.float64).T.ravel().tolist()
    lens, place = camera_and_place(camera, extent, unit_m=unit_m)
    document.cameras.append(lens)
    document.meshes.append(Mesh(name=name, primitives=[primitive]))
    kind = "Points" if primitive.mode == POINTS else "Mesh"
    document.nodes += [root, Node(name=kind, mesh=0), Node(name="Camera", camera=0, translation=place)]
    document.scenes.append(Scene(name=name, nodes=[0]))
    document.scene = 0


def check_textures(target: Path, storage: TextureFormat) -> None:
    """Check that a .glb can hold textures that are stored so: it has no place for EXR."""
    if storage is TextureFormat.EXR:
        raise AssetError(f"{target} cannot hold EXR textures: a .glb takes PNG; store the textures as png16, or export a .usda or .usdc")


def write_textures(maps: SurfaceMaps, mesh: SurfaceMesh, folder: Path, *, look: MetallicLook | None,
                   storage: TextureFormat = TextureFormat.PNG16, progress: Progress | None = None) -> dict[str, Texture]:
    """Write the images that a glTF material of solved maps uses, and return them by name.

    METALLIC_ROUGHNESS is there only where a highlight was fitted.
    `mesh`: of these maps; the normal map is relative to its frame. `look`: of these maps, where they have reflectance. `storage`: PNG16 or
    PNG8, the bits of the images that are no colours."""
    reach = max(BLEED_TEXELS, mesh.step)
    data: type[np.unsignedinteger[Any]] = np.uint8 if storage is TextureFormat.PNG8 else np.uint16

    def write(name: str, codes: np.ndarray, known: np.ndarray, clipped: int) -> Texture:
        write_png(folder / f"{name}.png", bleed(codes, known, reach=reach, in_place=True), srgb=name == BASE_COLOR)
        return Texture(f"{name}.png", DISPLAY_SPACE if name == BASE_COLOR else DATA_SPACE, clipped)

    def write_base_color(look: MetallicLook) -> Texture:
        codes, clipped = encode(look.base_color, look.known, maps.color_space, np.uint8)
        return write(BASE_COLOR, codes, look.known, clipped)

    def write_metallic_roughness(look: MetallicLook, roughness: np.ndarray) -> Texture:
        known = look.known & np.isfinite(roughness)
        green, clipped = encode(roughness, known, None, data)
        blue, _ = encode(look.metallic, known, None, data)
        red = np.full_like(green, np.iinfo(data).max)  # readers that expect three maps in one image take it as no occlusion
        return write(METALLIC_ROUGHNESS, np.stack([red, green, blue], axis=-1), known, clipped)

    def write_normal(normal: np.ndarray) -> Texture:
        codes, known, clipped = encode_normals(normal, maps.mask & np.isfinite(normal.sum(axis=-1)), mesh, data)
        return write(NORMAL, codes, known, clipped)

    writers: dict[str, Callable[[], Texture]] = {}
    if look is not None:
        writers[BASE_COLOR] = partial(write_base_color, look)
        if maps.specular is not None and maps.roughness is not None:
            writers[METALLIC_ROUGHNESS] = partial(write_metallic_roughness, look, maps.roughness)
    if maps.normal is not None:
        writers[NORMAL] = partial(write_normal, maps.normal)
    return side_by_side(writers, progress)


def add_material(glb: Glb, textures: Mapping[str, Texture], folder: Path, *, name: str, ior: float = GLASS_IOR) -> int:
    """Add a material that uses these textures, and return its number.

    Convention:
        A surface without specular reflection has `specularFactor` 0 (KHR_materials_specular): F0 and F90 are 0, and what is left is
        Lambert's law. The index of refraction of dielectrics is written where it is not 1.5, the default (KHR_materials_ior).
    """
    document = glb.document
    if textures:
        document.samplers.append(gltf.Sampler(magFilter=gltf.LINEAR, minFilter=gltf.LINEAR_MIPMAP_LINEAR, wrapS=gltf.CLAMP_TO_EDGE,
                                              wrapT=gltf.CLAMP_TO_EDGE))
    numbers: dict[str, int] = {}
    for image, texture in textures.items():
        document.textures.append(gltf.Texture(source=glb.add_png(folder / texture.file_name), sampler=0, name=image))
        numbers[image] = len(document.textures) - 1

    surface = gltf.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0)
    if BASE_COLOR in numbers:
        surface.baseColorTexture = gltf.TextureInfo(index=numbers[BASE_COLOR])
    else:
        surface.baseColorFactor = [NEUTRAL_GREY] * 3 + [1.0]
    material = gltf.Material(name=name, pbrMetallicRoughness=surface, doubleSided=True)
    if METALLIC_ROUGHNESS in numbers:
        surface.metallicRoughnessTexture = gltf.TextureInfo(index=numbers[METALLIC_ROUGHNESS])
        surface.metallicFactor = 1.0
        if ior != GLASS_IOR:
            material.extensions = {"KHR_materials_ior": {"ior": ior}}
    else:
        material.extensions = {"KHR_materials_specular": {"specularFactor": 0.0}}
    if NORMAL in numbers:
        material.normalTexture = gltf.NormalMaterialTexture(index=numbers[NORMAL])
    document.extensionsUsed += list(material.extensions)
    document.materials.append(material)
    return len(document.materials) - 1


def add_unlit_material(glb: Glb, *, name: str, coloured: bool) -> int:
    """Add a material that shows the colours of points as they were measured, or grey, and return its number (KHR_materials_unlit)."""
    shade = 1.0 if coloured else NEUTRAL_GREY
    glb.document.materials.append(gltf.Material(
        name=name, extensions={"KHR_materials_unlit": {}},
        pbrMetallicRoughness=gltf.PbrMetallicRoughness(baseColorFactor=[shade] * 3 + [1.0], metallicFactor=0.0, roughnessFactor=1.0)))
    glb.document.extensionsUsed.append("KHR_materials_unlit")
    return len(glb.document.materials) - 1
