"""Opens an asset in Blender and renders it with Cycles; runs in a Python with bpy, which has nothing of relit.

    python one_after_another.py inside_blender.py

Convention:
    Blender's world is z up: its USD and glTF importers turn the asset's y-up world by 90° about x, so (x, y, z) becomes (x, -z, y).
    A Blender camera looks along its -z with +y up, as relit's does.

Source: Blender manual, "Cameras" (sensor fit, shift) and "Environment Texture"; intern/cycles/kernel/camera/projection.h,
direction_to_equirectangular, for the axes of lat-long pictures.
"""

import json
import math

import bpy
from mathutils import Matrix, Vector

ZUP_FROM_YUP = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
LOOKUP_FROM_CAMERA = Matrix(((0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
"""Blender's picture has its centre at +x, a quarter from the left at +y, and +z at the top."""
FINER = 2
"""Columns of the table by which Cycles chooses directions, for each of the environment's. The table that it makes by itself
takes several times as long as a small picture, whose noise is the same."""


def main(path: str) -> None:
    """Render the job of this file."""
    with open(path) as stream:
        job = json.load(stream)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if job["asset"].endswith((".glb", ".gltf")):
        bpy.ops.import_scene.gltf(filepath=job["asset"])
    else:
        bpy.ops.wm.usd_import(filepath=job["asset"])
    for lamp in [each for each in bpy.data.objects if each.type == "LIGHT"]:
        bpy.data.objects.remove(lamp)  # the job's light is the only one
    world_from_camera = ZUP_FROM_YUP @ Matrix(job["camera"]["world_from_camera"] or Matrix.Identity(4))
    scene = bpy.context.scene
    place_camera(scene, job["camera"], world_from_camera)
    light(scene, job, world_from_camera)
    set_renderer(scene, job)
    bpy.ops.render.render(write_still=True)


def place_camera(scene, camera: dict, world_from_camera: Matrix) -> None:
    """Make the capturing camera the scene's camera."""
    width, height = camera["resolution"]
    data = bpy.data.cameras.new("capture")
    view = bpy.data.objects.new("capture", data)
    scene.collection.objects.link(view)
    scene.camera = view
    data.sensor_fit = "HORIZONTAL"
    cu, cv = camera["principal_px"] or (width / 2, height / 2)
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    bpy.context.view_layer.update()
    corners = [each.matrix_world @ Vector(corner) for each in scene.objects if each.type == "MESH" for corner in each.bound_box]
    inverse = world_from_camera.inverted()
    depths = [-(inverse @ corner).z for corner in corners]
    if camera["projection"] == "perspective":
        fx, fy = camera["focal_px"]
        data.type = "PERSP"
        data.lens = data.sensor_width * fx / width
        stretch = fx / fy  # height of a pixel in widths
        scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = (1.0, stretch) if stretch >= 1 else (1 / stretch, 1.0)
        data.shift_x, data.shift_y = (width / 2 - cu) / width, (cv - height / 2) / width * stretch
        data.clip_start, data.clip_end = min(depths) / 2, max(depths) * 2
        view.matrix_world = world_from_camera
    else:
        unit = camera["pixel_size_m"] or 0.001  # without a scale the asset's pixel is a millimetre
        data.type = "ORTHO"
        data.ortho_scale = unit * width
        back = unit * width - min(depths)
        data.shift_x, data.shift_y = (width / 2 - cu) / width, (cv - height / 2) / width
        data.clip_start, data.clip_end = unit, 4 * unit * width + max(depths) - min(depths)
        view.matrix_world = world_from_camera @ Matrix.Translation((0, 0, back))


def light(scene, job: dict, world_from_camera: Matrix) -> None:
    """Make the job's light the only one."""
    turn = world_from_camera.to_3x3().to_4x4()
    world = bpy.data.worlds.new("environment")
    scene.world = world
    world.use_nodes = True
    tree = world.node_tree
    tree.nodes.clear()
    output, background = tree.nodes.new("ShaderNodeOutputWorld"), tree.nodes.new("ShaderNodeBackground")
    tree.links.new(background.outputs["Background"], output.inputs["Surface"])
    if "sun" in job:
        background.inputs["Strength"].default_value = 0
        data = bpy.data.lights.new("sun", "SUN")
        data.angle = 0
        data.energy = max(job["sun"]["irradiance"])  # W/m² on a surface that faces it
        data.color = [value / data.energy for value in job["sun"]["irradiance"]]
        sun = bpy.data.objects.new("sun", data)
        scene.collection.objects.link(sun)
        towards = turn @ Vector(job["sun"]["direction"])
        sun.rotation_mode = "QUATERNION"
        sun.rotation_quaternion = towards.to_track_quat("Z", "Y")  # a sun shines along its -z
        return
    image = bpy.data.images.load(job["environment"])
    image.colorspace_settings.name = "Linear Rec.709"
    world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", FINER * image.size[0]
    texture, mapping, direction = (tree.nodes.new(f"ShaderNode{name}") for name in ("TexEnvironment", "Mapping", "TexCoord"))
    texture.image = image
    mapping.vector_type = "POINT"
    mapping.inputs["Rotation"].default_value = (LOOKUP_FROM_CAMERA @ turn.inverted()).to_euler("XYZ")
    tree.links.new(direction.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    tree.links.new(texture.outputs["Color"], background.inputs["Color"])


def set_renderer(scene, job: dict) -> None:
    """Let Cycles write what it computes: no denoising, clamping, or display transform, and a box filter of one pixel."""
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", job["samples"], 1
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = job["bounces"] - 1
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Raw"
    scene.render.use_compositing = scene.render.use_sequencer = False
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth, settings.exr_codec = "OPEN_EXR", "RGBA", "32", "ZIP"
    scene.render.filepath = job["out"]


assert math.isclose(LOOKUP_FROM_CAMERA.determinant(), 1)  # a rotation, so that Euler angles can say it
