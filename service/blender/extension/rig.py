"""The captured lights of an asset, of which one at a time is on.

Convention:
    Blender takes a normalised UsdLux light of a rig four times as bright and its angle twice as large. Its sun has the irradiance in W/m²,
    and its point light 4π times the radiant intensity. `relit:intensity` of a rig is the irradiance of a distant light, and four times the
    radiant intensity of a point light.
"""

import math

import bpy
from mathutils import Vector

MODES = [("CAPTURED", "Captured Light", "One light of the capture, and no world"),
         ("ENVIRONMENT", "Environment", "The environment that the asset brings along"),
         ("SCENE", "Scene", "The lights and the world of the scene")]


def take(objects: list[bpy.types.Object], root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the lights among imported objects in their order, each as bright as it was, and remove the other objects."""
    lamps = [each for each in objects if each.type == "LIGHT" and "relit:frame" in each.data]
    lamps.sort(key=lambda each: each.data["relit:frame"])
    for index, lamp in enumerate(lamps):
        world = lamp.matrix_world.copy()
        lamp.parent = root
        lamp.matrix_world = world
        lamp["relit_light"] = index
        sun = lamp.data.type == "SUN"
        lamp.data.energy = lamp.data["relit:intensity"] * (1 if sun else math.pi)
        if sun:
            lamp.data.angle /= 2
        else:
            lamp.data.shadow_soft_size = 0
    for each in objects:
        if each not in lamps:
            bpy.data.objects.remove(each)
    return lamps


def lamps_of(root: bpy.types.Object | None) -> list[bpy.types.Object]:
    """Return the captured lights below a root, by index."""
    found = [each for each in root.children if "relit_light" in each] if root is not None else []
    return sorted(found, key=lambda each: each["relit_light"])


def frontal(root: bpy.types.Object) -> int:
    """Return the index of the captured light that is nearest to the view axis."""
    def cosine(lamp: bpy.types.Object) -> float:
        local = root.matrix_world.inverted() @ lamp.matrix_world
        towards = local.to_3x3() @ Vector((0, 0, 1)) if lamp.data.type == "SUN" else local.translation
        return towards.normalized().z

    lamps = lamps_of(root)
    return max(range(len(lamps)), key=lambda index: cosine(lamps[index]))


def update(given: bpy.types.PropertyGroup, context: bpy.types.Context | None = None) -> None:
    """Let the chosen light be the only one, or leave the light to the scene."""
    scene = given.id_data
    lamps = lamps_of(given.root)
    if lamps and given.light_index >= len(lamps):
        given.light_index = len(lamps) - 1  # which calls this function again
        return
    for index, lamp in enumerate(lamps):
        lamp.hide_render = lamp.hide_viewport = not (given.light == "CAPTURED" and index == given.light_index)
    if scene.world not in (None, given.environment):
        given.world = scene.world  # what the user has chosen meanwhile
    scene.world = {"CAPTURED": None, "ENVIRONMENT": given.environment, "SCENE": given.world}[given.light]
