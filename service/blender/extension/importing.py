"""Import of an asset with its camera, its rig and its environment."""

import json
import re
import tempfile
from pathlib import Path

import bpy
from bpy.props import BoolProperty
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from . import camera, environment, rig, settings
from .operator import RelitOperator
from .tasks import Failure

SUFFIXES = (".usda", ".usdc", ".usdz", ".glb")
VARIANTS = """#usda 1.0
(
    defaultPrim = "Asset"
    metersPerUnit = {unit}
    upAxis = "Y"
)

def "Asset" (
    references = @@@{path}@@@
    variants = {{
{choices}    }}
)
{{
}}
"""
"""A layer that chooses variants of an asset, with its unit and axis, which importers read of the outermost layer alone."""
NEAR_PX = 1.0
"""A corner of the asset is at most so far from its place in the picture, in pixels, where its own camera and that of the capture agree."""


class RELIT_OT_import_asset(RelitOperator):
    """Import the asset, with its camera, its captured lights and its environment, so that a render matches the photograph."""

    bl_idname = "relit.import_asset"
    bl_label = "Import Asset"
    bl_options = {"REGISTER", "UNDO"}

    new_scene: BoolProperty(name="New Scene", default=True, description="Import into a scene of its own, under one captured light")

    def act(self, context: bpy.types.Context) -> None:
        """Import into a new scene, or into this one, whose render and light then stay as they are."""
        bring_in(context, asset_file(context.scene.relit), new_scene=self.new_scene)


def asset_file(given: settings.Settings) -> Path:
    """Return the asset; raise Failure if it is not there, or of another kind."""
    path = Path(bpy.path.abspath(given.asset)) if given.asset else settings.out_folder(given) / "asset.usda"
    if path.suffix.lower() not in SUFFIXES:
        raise Failure(f"{path} is no asset: give a file that ends with {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise Failure(f"{path} is not there: solve the capture, or give an asset of relit export")
    return path


def bring_in(context: bpy.types.Context, path: Path, *, new_scene: bool) -> bpy.types.Object:
    """Import an asset and return its root; raise Failure and leave the file as it was if that cannot be."""
    given = context.scene.relit
    capture = _camera_of(path, given)
    before, made = context.scene, None
    known = set(bpy.data.user_map())
    if new_scene:
        made = bpy.data.scenes.new(_name(path))
        for name in settings.Settings.__annotations__:
            if name not in ("root", "world", "environment", "light", "light_index"):
                setattr(made.relit, name, getattr(given, name))
        context.window.scene = made
    try:
        return _fill(context, path, capture, new_scene)
    except Exception:
        if made is not None:
            context.window.scene = before
        bpy.data.batch_remove(set(bpy.data.user_map()) - known)
        raise


def _fill(context: bpy.types.Context, path: Path, capture: dict, new_scene: bool) -> bpy.types.Object:
    scene, given = context.scene, context.scene.relit
    collection = bpy.data.collections.new(_name(path))
    scene.collection.children.link(collection)
    root = camera.add_root(_name(path), capture, collection)
    root["relit_camera"], root["relit_unit_m"] = capture, camera.unit_m(capture)
    objects = _import(context, path, root, {"geo": given.mesh, "look": given.look})
    meshes = [each for each in objects if each.type == "MESH"]
    materials = {_stem(each.name) for mesh in meshes for each in mesh.data.materials}
    chosen = (given.mesh == "mesh" or given.mesh.title() in {_stem(each.name) for each in meshes}) and (
        given.look == "metallic" or given.look.title() in materials)  # USD shows the default in place of a variant that is not there
    if not meshes or not chosen:
        raise Failure(f"{path.name} has no mesh {given.mesh!r} with the look {given.look!r}: choose others, or export it with --levels")
    _move(objects, collection)
    for each in objects:
        if each.parent is None:
            world = each.matrix_world.copy()
            each.parent = root
            each.matrix_world = world
    context.view_layer.update()
    view = camera.add_camera(root, capture, scene, collection)
    context.view_layer.update()
    if path.suffix.lower() != ".glb":  # whose cameras have no principal point
        _compare(scene, capture, view, objects)
    for each in [each for each in objects if each.type in ("CAMERA", "LIGHT")]:
        bpy.data.objects.remove(each)
    lights = path.with_name(f"{path.stem}_lights")
    lamps = rig.take(_import(context, lights / "rig.usda", root, {}), root) if (lights / "rig.usda").is_file() else []
    _move(lamps, collection)
    given.root, given.world, given.environment = root, scene.world, None
    if (lights / "environment.exr").is_file():
        given.environment = environment.world_of(lights / "environment.exr", root)
    if new_scene:
        camera.frame(view, capture["resolution"], scene)
    context.view_layer.update()
    if lamps:
        given.light_index = rig.frontal(root)
    given.light = "SCENE" if not new_scene else "CAPTURED" if lamps else "ENVIRONMENT" if given.environment else "SCENE"
    return root


def _name(path: Path) -> str:
    """Return what an asset is called in Blender: its file's name, or that of the folder of results."""
    return path.parent.name if path.stem == "asset" else path.stem


def _move(objects: list[bpy.types.Object], collection: bpy.types.Collection) -> None:
    """Put imported objects, which lie where the user was at work, into the asset's collection."""
    for each in objects:
        for home in each.users_collection:
            home.objects.unlink(each)
        collection.objects.link(each)


def _camera_of(path: Path, given: settings.Settings) -> dict:
    """Return the camera that the asset names, which is that of a part where the capture was cropped, else that of the capture."""
    if path.suffix.lower() == ".usda" and (match := re.search(r"string camera = '(\{.*\})'", path.read_text(encoding="utf-8"))):
        return {name: value for name, value in json.loads(match[1]).items() if value is not None}
    return {name: value for name, value in settings.manifest(given)["camera"].items() if value is not None}


def _import(context: bpy.types.Context, path: Path, root: bpy.types.Object, variants: dict[str, str]) -> list[bpy.types.Object]:
    """Return the objects that an importer of Blender makes of a file; variants of USD are chosen in a layer that refers to it."""
    known = set(bpy.data.objects)
    usd = bpy.ops.wm.usd_import
    options = {name: False for name in ("create_world_material", "set_frame_range") if name in usd.get_rna_type().properties}
    choices = "".join(f'        string {name} = "{value}"\n' for name, value in variants.items())
    try:
        if path.suffix.lower() == ".glb":
            bpy.ops.import_scene.gltf(filepath=str(path))
        else:
            with tempfile.TemporaryDirectory() as folder:
                layer = Path(folder) / "variants.usda"
                layer.write_text(VARIANTS.format(path=path.as_posix(), unit=root["relit_unit_m"], choices=choices), encoding="utf-8")
                usd(filepath=str(layer), **options)
    except RuntimeError as error:  # of an importer, which reports one
        raise Failure(f"{path} cannot be imported: {str(error).strip()}") from error
    context.view_layer.update()
    return [each for each in bpy.data.objects if each not in known]


def _stem(name: str) -> str:
    """Return a name without the number that Blender appends to a second one."""
    return re.sub(r"\.\d+$", "", name)


def _compare(scene: bpy.types.Scene, capture: dict, view: bpy.types.Object, objects: list[bpy.types.Object]) -> None:
    """Raise Failure if the asset's own camera saw something else than the capture's: they are not of one another."""
    others = [each for each in objects if each.type == "CAMERA" and each.data.type == "PERSP"]
    if capture["projection"] == "orthographic":
        others = [each for each in others if each.name.startswith("CameraPerspective")]
    if not others:
        return
    render = scene.render
    kept = render.resolution_x, render.resolution_y, render.pixel_aspect_x, render.pixel_aspect_y
    render.resolution_x, render.resolution_y = capture["resolution"]
    render.pixel_aspect_x, render.pixel_aspect_y = view["relit_pixel_aspect"]
    points = [each.matrix_world @ Vector(corner) for each in objects if each.type == "MESH" for corner in each.bound_box]
    apart = max(abs((one - other)[axis]) * capture["resolution"][axis] for point in points for axis in (0, 1)
                for one, other in [(world_to_camera_view(scene, view, point), world_to_camera_view(scene, others[0], point))])
    render.resolution_x, render.resolution_y, render.pixel_aspect_x, render.pixel_aspect_y = kept
    if apart > NEAR_PX:
        raise Failure(f"the asset and the capture have different cameras (points are {apart:.0f} pixels apart): give the capture of this "
                      "asset")
