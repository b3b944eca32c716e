"""What the panel asks for, kept with the scene."""

import json
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, PointerProperty, StringProperty

from . import rig
from .tasks import Failure

MESHES = [("mesh", "Full", "A vertex for each pixel"), *(
    (f"lod{level}", f"Level {level}", f"About 1/{4**level} of the faces") for level in (1, 2, 3, 4))]
LOOKS = [("metallic", "Metallic", "Base colour and metallic"), ("specular", "Specular", "Diffuse albedo and F0, as they were fitted")]
METHODS = [("RELIGHT", "Photographs", "relit relight: a weighted sum of the captured images; near lights are taken as distant"),
           ("SHADE", "Near lights", "relit shade: the solved maps under lights at their places")]


class Settings(bpy.types.PropertyGroup):
    """A capture, its asset, and how it is lit."""

    capture: StringProperty(name="Capture", subtype="DIR_PATH", description="Folder with a capture.json")
    out: StringProperty(name="Results", subtype="DIR_PATH", description="Folder for maps, asset and frames; empty: CAPTURE_relit")
    sky: StringProperty(name="Environment", subtype="FILE_PATH", description="Lat-long .exr or .hdr that the asset brings along")
    levels: IntProperty(name="Mesh Levels", min=0, max=4, default=2, description="Levels of detail, each with a quarter of the faces")
    asset: StringProperty(name="Asset", subtype="FILE_PATH", description="Asset of relit export; empty: that of Results")
    mesh: EnumProperty(name="Mesh", items=MESHES)
    look: EnumProperty(name="Look", items=LOOKS)
    light: EnumProperty(name="Light", items=rig.MODES, default="SCENE", update=rig.update)
    light_index: IntProperty(name="Captured Light", min=0, update=rig.update, description="Place of the light in the rig, from 0")
    root: PointerProperty(name="Camera Frame", type=bpy.types.Object, description="Empty in the camera frame of the capture")
    world: PointerProperty(type=bpy.types.World, description="World of the scene")
    environment: PointerProperty(type=bpy.types.World, description="World of the asset's environment")
    method: EnumProperty(name="Relight", items=METHODS)
    guided: BoolProperty(name="Guided by Maps", default=True, description="A model of the solved maps supplies highlights and shadows")
    place: EnumProperty(name="Card", items=[("BEHIND", "Behind", "Behind the object"), ("BESIDE", "Beside", "At the right of the object")])


def capture_folder(given: Settings) -> Path:
    """Return the capture's folder; raise Failure if it is none."""
    if not given.capture:
        raise Failure("no capture is chosen: give a folder with a capture.json")
    folder = Path(bpy.path.abspath(given.capture))
    if not (folder / "capture.json").is_file():
        raise Failure(f"{folder} is no capture: it has no capture.json")
    return folder


def out_folder(given: Settings) -> Path:
    """Return the folder for results."""
    if given.out:
        return Path(bpy.path.abspath(given.out))
    capture = capture_folder(given)
    return capture.with_name(f"{capture.name}_relit")


def sky_file(given: Settings) -> Path | None:
    """Return the environment map; raise Failure if there is none of that name."""
    if not given.sky:
        return None
    path = Path(bpy.path.abspath(given.sky))
    if not path.is_file():
        raise Failure(f"{path} is not there: give an environment map, or leave the field empty")
    return path


def manifest(given: Settings) -> dict:
    """Return the manifest of the capture; raise Failure if it cannot be read."""
    path = capture_folder(given) / "capture.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        found["camera"]["resolution"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Failure(f"{path} cannot be read as a manifest: {type(error).__name__}: {error}") from error
    return found
