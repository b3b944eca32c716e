"""Relit frames on a card: a rectangle in the plane of the image that emits the frames and lights nothing."""

import re
from pathlib import Path

import bpy
from mathutils import Matrix

from . import camera
from .tasks import Failure

GAP = 0.05
"""Space between the object and the card, and between the picture and a card beside it, in widths of the picture."""
UNLIT = ("visible_diffuse", "visible_glossy", "visible_transmission", "visible_volume_scatter", "visible_shadow")


def files_of(first: Path) -> dict[int, Path]:
    """Return the frames of the sequence to which a file belongs, by number; raise Failure if its name has none."""
    match = re.fullmatch(r"(.*?)(\d+)(\.[^.]+)", first.name)
    if match is None or not first.is_file():
        raise Failure(f"{first} is no frame of a sequence: give a file such as frame.0001.exr")
    pattern = re.compile(re.escape(match[1]) + r"(\d+)" + re.escape(match[3]))
    return {int(found[1]): each for each in sorted(first.parent.iterdir()) if (found := pattern.fullmatch(each.name))}


def show(root: bpy.types.Object, files: dict[int, Path], place: str) -> bpy.types.Object:
    """Return a new card with frames of the capture, behind the object or beside it; an earlier card of the same files goes."""
    first = files[min(files)]
    for each in [each for each in root.children if each.get("relit_card") == str(first)]:
        mesh, materials = each.data, [*each.data.materials]
        bpy.data.objects.remove(each)
        for unused in (mesh, *materials):
            if unused is not None and not unused.users:
                bpy.data.batch_remove([unused])
    capture = root["relit_camera"].to_dict()
    width, height = capture["resolution"]
    cu, cv = capture.get("principal_px") or (width / 2, height / 2)
    left = width * (1 + GAP) if place == "BESIDE" else 0
    depth = min(corner.z for corner in camera.corners(root))
    if capture["projection"] == "perspective":
        depth *= 1 + GAP
        size_x, size_y = (-depth / focal for focal in capture["focal_px"])
    else:
        size_x = size_y = capture.get("pixel_size_m") or camera.PIXEL_M
        depth -= GAP * width * size_x
    corners = [((column - cu) * size_x, (cv - row) * size_y, depth)
               for column, row in ((left, height), (left + width, height), (left + width, 0), (left, 0))]
    mesh = bpy.data.meshes.new("Relit frames")
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    for loop, st in zip(mesh.uv_layers.new().data, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
        loop.uv = st
    mesh.materials.append(_material(files))
    card = bpy.data.objects.new("Relit frames", mesh)
    card["relit_card"] = str(first)
    root.users_collection[0].objects.link(card)
    card.parent, card.matrix_parent_inverse = root, Matrix.Identity(4)
    for name in UNLIT:
        setattr(card, name, False)
    return card


def compare(root: bpy.types.Object, window: bpy.types.Window) -> None:
    """Show the frames of the latest card of a capture and Blender's own render in two Image Editors of a window, side by side.

    Editors that the window has are taken first; what it lacks is split off its largest area. Raise Failure where there is no card or no
    render."""
    cards = [each for each in root.children if "relit_card" in each]
    rendered = next((each for each in bpy.data.images if each.type == "RENDER_RESULT"), None)
    if not cards:
        raise Failure("there are no frames yet: relight a frame range, or show frames that are there")
    if rendered is None:
        raise Failure("Blender has rendered nothing yet: render the scene, and compare then")
    texture = next(node for node in cards[-1].data.materials[0].node_tree.nodes if node.type == "TEX_IMAGE")
    for area, image in zip(_editors(window), (rendered, texture.image), strict=True):
        space = area.spaces.active
        space.image = image
        if image.source == "SEQUENCE":
            for name in ("frame_start", "frame_offset", "frame_duration"):
                setattr(space.image_user, name, getattr(texture.image_user, name))
            space.image_user.use_auto_refresh = True


def _editors(window: bpy.types.Window) -> list[bpy.types.Area]:
    """Return two Image Editors of a window, from left to right."""
    while len(found := [each for each in window.screen.areas if each.type == "IMAGE_EDITOR"]) < 2:
        area = found[0] if found else max(window.screen.areas, key=lambda each: each.width * each.height)
        before = {each.as_pointer() for each in window.screen.areas}
        with bpy.context.temp_override(window=window, screen=window.screen, area=area):
            bpy.ops.screen.area_split(direction="VERTICAL", factor=0.5)
        made = next((each for each in window.screen.areas if each.as_pointer() not in before), None)
        if made is None:
            raise Failure("the window has no room for two Image Editors: open them, and compare then")
        made.type = "IMAGE_EDITOR"
    return sorted(found[:2], key=lambda each: each.x)


def _material(files: dict[int, Path]) -> bpy.types.Material:
    """Return a material that emits the frames; where they are premultiplied, it shows what is behind them."""
    image = bpy.data.images.load(str(files[min(files)]), check_existing=True)
    image.reload()
    image.alpha_mode = "PREMUL"
    material = bpy.data.materials.new("Relit frames")
    if material.node_tree is None:
        material.use_nodes = True  # Blender 4; later ones have nodes always
    tree = material.node_tree
    tree.nodes.clear()
    output, mix, clear, glow, texture = (tree.nodes.new(f"ShaderNode{name}") for name in (
        "OutputMaterial", "MixShader", "BsdfTransparent", "Emission", "TexImage"))
    texture.image, texture.interpolation, texture.extension = image, "Closest", "EXTEND"
    image.source = "SEQUENCE" if len(files) > 1 else "FILE"  # an earlier card of the file may have set it
    if len(files) > 1:
        user = texture.image_user
        user.frame_start, user.frame_offset, user.frame_duration = min(files), min(files) - 1, max(files) - min(files) + 1
        user.use_auto_refresh = True
    for source, target in ((texture.outputs["Color"], glow.inputs["Color"]), (texture.outputs["Alpha"], mix.inputs[0]),
                           (clear.outputs[0], mix.inputs[1]), (glow.outputs[0], mix.inputs[2]), (mix.outputs[0], output.inputs["Surface"])):
        tree.links.new(source, target)
    return material
