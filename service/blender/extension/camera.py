"""The capturing camera, and the empty that stands in its frame.

Convention:
    Blender's world is z up: its USD and glTF importers turn the y-up world of an asset by 90° about x. A Blender camera looks along its -z
    with +y up, as the camera frame of a capture does.

Source: Blender manual, "Cameras" (sensor fit, shift).
"""

import bpy
from mathutils import Matrix, Vector

ZUP_FROM_YUP = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
PIXEL_M = 0.001
"""Metres of a pixel in the asset of a capture without a scale."""


def add_root(name: str, camera: dict, collection: bpy.types.Collection) -> bpy.types.Object:
    """Return a new empty in the camera frame: the parent of everything that is imported."""
    root = bpy.data.objects.new(f"{name} camera frame", None)
    root.empty_display_type = "ARROWS"
    root.empty_display_size = 0.05
    root.matrix_world = ZUP_FROM_YUP @ Matrix(camera.get("world_from_camera") or Matrix.Identity(4))
    collection.objects.link(root)
    return root


def unit_m(camera: dict) -> float:
    """Return how many metres of the asset are one unit of the camera frame: 1, or those of a pixel where the capture has no scale."""
    metric = camera.get("pixel_size_m") if camera["projection"] == "orthographic" else camera.get("surface_z_m")
    return 1.0 if metric else PIXEL_M


def corners(root: bpy.types.Object) -> list[Vector]:
    """Return the corners of the boxes around the surfaces of the asset, in the camera frame."""
    inverse = root.matrix_world.inverted()
    return [inverse @ each.matrix_world @ Vector(corner) for each in root.children_recursive
            if each.type == "MESH" and "relit_card" not in each for corner in each.bound_box]


def add_camera(root: bpy.types.Object, camera: dict, scene: bpy.types.Scene, collection: bpy.types.Collection) -> bpy.types.Object:
    """Return a new camera that sees what the capturing camera saw, at the resolution of the capture."""
    width, height = camera["resolution"]
    data = bpy.data.cameras.new("Capture")
    view = bpy.data.objects.new("Capture", data)
    collection.objects.link(view)
    view.parent = root
    data.sensor_fit = "HORIZONTAL"
    cu, cv = camera.get("principal_px") or (width / 2, height / 2)
    depths = [-corner.z for corner in corners(root)]
    if camera["projection"] == "perspective":
        fx, fy = camera["focal_px"]
        stretch = fx / fy  # height of a pixel in widths
        data.lens = data.sensor_width * fx / width
        data.shift_x, data.shift_y = (width / 2 - cu) / width, (cv - height / 2) / width * stretch
        data.clip_start, data.clip_end = min(depths) / 2, max(depths) * 4
    else:
        stretch = 1.0
        span = (camera.get("pixel_size_m") or PIXEL_M) * width
        data.type = "ORTHO"
        data.ortho_scale = span
        data.shift_x, data.shift_y = (width / 2 - cu) / width, (cv - height / 2) / width
        view.location.z = span - min(depths)
        data.clip_start, data.clip_end = span / 100, 8 * span + 4 * (max(depths) - min(depths))
    view["relit_pixel_aspect"] = (1.0, stretch) if stretch >= 1 else (1 / stretch, 1.0)
    return view


def frame(view: bpy.types.Object, resolution: list[int], scene: bpy.types.Scene) -> None:
    """Make the picture of a scene that of the capture: its camera and pixels, and colours that compare."""
    scene.camera = view
    render, shown = scene.render, scene.view_settings
    render.resolution_x, render.resolution_y = resolution
    render.resolution_percentage = 100
    render.pixel_aspect_x, render.pixel_aspect_y = view["relit_pixel_aspect"]
    render.engine = "CYCLES"
    render.film_transparent = True
    shown.view_transform, shown.look, shown.exposure, shown.gamma = "Standard", "None", 0.0, 1.0
