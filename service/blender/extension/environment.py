"""Environments: a map of a capture as Blender's world, and Blender's world as a map for Relit.

Convention:
    A map of Relit has +y of the camera frame in its top row, +z at its centre and +x a quarter from the left. That of Blender's world has
    +z at the top, +x at its centre and +y a quarter from the left; a panoramic camera has -z of its own at the centre.

Source: Blender manual, "Environment Texture"; intern/cycles/kernel/camera/projection.h, direction_to_equirectangular.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import bpy
from mathutils import Matrix

from .tasks import Failure

LOOKUP_FROM_CAMERA = Matrix(((0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
HEIGHT = 256
"""Rows of a map that is written of a world."""
PATHS = 32
"""Rays of a pixel of such a map: the sun of a sky covers half of one."""
TURNED = 1e-5
"""Elements of two rotations that differ by more are not the same rotation in float32."""


def world_of(path: Path, root: bpy.types.Object) -> bpy.types.World:
    """Return a new world that shines as the map of a capture; it keeps to the camera frame as it is now."""
    world = bpy.data.worlds.new(f"{path.stem} environment")
    if world.node_tree is None:
        world.use_nodes = True  # Blender 4; later ones have nodes always
    tree = world.node_tree
    tree.nodes.clear()
    output, background, texture, mapping, direction = (tree.nodes.new(f"ShaderNode{name}") for name in (
        "OutputWorld", "Background", "TexEnvironment", "Mapping", "TexCoord"))
    texture.image = bpy.data.images.load(str(path))
    texture.image.colorspace_settings.name = "Linear Rec.709"
    mapping.vector_type = "POINT"
    turn = root.matrix_world.to_quaternion().to_matrix().to_4x4()
    mapping.inputs["Rotation"].default_value = (LOOKUP_FROM_CAMERA @ turn.inverted()).to_euler("XYZ")
    for source, name, target, other in ((direction, "Generated", mapping, "Vector"), (mapping, "Vector", texture, "Vector"),
                                        (texture, "Color", background, "Color"), (background, "Background", output, "Surface")):
        tree.links.new(source.outputs[name], target.inputs[other])
    return world


def write_world(scene: bpy.types.Scene, root: bpy.types.Object, frames: range, folder: Path, *, still: bool = False) -> Path | None:
    """Write the world of a scene in the camera frame of `root`, once or for each frame where it is animated or the camera frame turns.

    Returns the file, with #### for the number where there are several; None if there is no world or it is black.

    Raises:
        Failure: the world lights in a way that no map holds; with `still` also if one map is not enough.
    """
    world = scene.world
    if world is None:
        return None
    nodes = [*_nodes(world.node_tree)] if world.node_tree else []
    seen = world.cycles_visibility
    if any(node.type == "LIGHT_PATH" for node in nodes) or not (seen.diffuse and seen.glossy):
        raise Failure(f"the world {world.name} differs by the kind of ray, which no environment holds: remove its Light Path node, and let "
                      "all rays see it")
    kept = scene.frame_current
    turns = _turns(scene, root, frames)
    animated = world.animation_data is not None or any(map(_moves, [world.node_tree, *nodes])) or any(
        abs(one - other) > TURNED for turn in turns.values() for row, first in zip(turn, turns[frames[0]], strict=True)
        for one, other in zip(row, first, strict=True))
    if animated and still:
        raise Failure("the world is animated, or the camera frame turns, and a service takes one environment for all frames: use the "
                      "program relit")
    folder.mkdir(parents=True, exist_ok=True)
    other = bpy.data.scenes.new("Relit world")
    data = bpy.data.cameras.new("Relit world")
    view = bpy.data.objects.new("Relit world", data)
    alone = world.copy()
    alone.cycles.sampling_method = "NONE"  # nothing in the scene is lit by it, and its table would take most of the time
    try:
        other.collection.objects.link(view)
        other.camera, other.world = view, alone
        alone.cycles_visibility.camera = True
        data.type = "PANO"
        (data if hasattr(data, "panorama_type") else data.cycles).panorama_type = "EQUIRECTANGULAR"  # Blender 5, and 4
        render, cycles = other.render, other.cycles
        render.engine, render.resolution_x, render.resolution_y, render.resolution_percentage = "CYCLES", 2 * HEIGHT, HEIGHT, 100
        cycles.device, cycles.samples, cycles.use_denoising, cycles.use_adaptive_sampling = "CPU", PATHS, False, False
        cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
        cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
        settings = render.image_settings
        settings.file_format, settings.color_mode, settings.color_depth, settings.exr_codec = "OPEN_EXR", "RGB", "32", "ZIP"
        render.use_compositing = render.use_sequencer = False
        brightest = 0.0
        for number in frames if animated else frames[:1]:
            scene.frame_set(number)  # without which the other scene stays at its frame
            other.frame_set(number)
            view.matrix_world = turns[number].to_4x4() @ Matrix.Rotation(math.pi, 4, "Y")
            path = folder / (f"world.{number:04d}.exr" if animated else "world.exr")
            render.filepath = str(path)
            bpy.ops.render.render(write_still=True, scene=other.name)
            image = bpy.data.images.load(str(path))
            brightest = max(brightest, *image.pixels[:])
            bpy.data.images.remove(image)
    finally:
        scene.frame_set(kept)
        bpy.data.scenes.remove(other)
        bpy.data.objects.remove(view)
        bpy.data.cameras.remove(data)
        bpy.data.worlds.remove(alone)
    return (folder / ("world.####.exr" if animated else "world.exr")) if brightest > 0 else None


def _turns(scene: bpy.types.Scene, root: bpy.types.Object, frames: range) -> dict[int, Matrix]:
    """Return the rotation of the camera frame in Blender's world at each frame."""
    kept, found = scene.frame_current, {}
    try:
        for number in frames:
            scene.frame_set(number)
            found[number] = root.matrix_world.to_quaternion().to_matrix()
    finally:
        scene.frame_set(kept)
    return found


def _nodes(tree: bpy.types.NodeTree) -> Iterator[bpy.types.Node]:
    """Yield the nodes of a tree, and those in its groups."""
    for node in tree.nodes:
        yield node
        if node.type == "GROUP" and node.node_tree is not None:
            yield from _nodes(node.node_tree)


def _moves(part: bpy.types.NodeTree | bpy.types.Node | None) -> bool:
    """Return True if a tree, the group or the image of a node, or an object by which it places a texture may change with the frame."""
    if part is None:
        return False
    image, tree = getattr(part, "image", None), getattr(part, "node_tree", part)
    return bool(getattr(tree, "animation_data", None) or getattr(part, "object", None) or (
        image is not None and image.source in ("SEQUENCE", "MOVIE")))
