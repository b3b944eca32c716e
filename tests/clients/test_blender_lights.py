"""Blender and Relit mean the same light: captured lights, exported lights and worlds, and cards, each against pictures that are known."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from benchmarks.clients.comparison import compare
from benchmarks.clients.panel import picture
from service.export.export import export
from service.requests.export import ExportRequest
from stage.formats import exr
from stage.results.maps import MAPS_FILE, SurfaceMaps
from stage.transforms import fibonacci_sphere
from tests.clients.blender import in_blender
from tests.clients.scenes import directions, uneven
from tests.clients.test_conventions import CAMERAS, ball
from tests.scenes.captures import edit_frame, write_exr
from tests.scenes.surroundings import capture_of, write_frames

pytestmark = pytest.mark.long

DOME_LIGHTS = 64

NEAR = """
import importlib, os
from mathutils import Euler, Vector
lights = importlib.import_module(NAME + ".lights")
folder = given["folder"]
settings(capture=given["capture"], out=folder, asset=folder + "/asset.usda")
bpy.ops.relit.import_asset()
scene, root = bpy.context.scene, bpy.context.scene.relit.root
settings(light="SCENE", method="SHADE")
scene.frame_start = scene.frame_end = 1
root.matrix_world = root.matrix_world @ Euler((0.3, 0.5, -0.2)).to_matrix().to_4x4()
root.location, root.scale = (1, 2, 3), (1.5, 1.5, 1.5)
bpy.context.view_layer.update()
centre = lights.subject_of(root).centre

def lamp(kind, place, size=0.0, **values):
    data = bpy.data.lights.new(kind, kind)
    for name, value in values.items():
        setattr(data, name, value)
    made = bpy.data.objects.new(kind, data)
    scene.collection.objects.link(made)
    made.rotation_mode = "QUATERNION"
    made.location = root.matrix_world @ Vector(place)
    made.rotation_quaternion = (made.location - centre).to_track_quat("Z", "Y")
    return made

at = given["at"]
LAMPS = {
    "sun": dict(kind="SUN", energy=3, angle=0.2, color=(1, 0.5, 0.25)),
    "point": dict(kind="POINT", energy=2, shadow_soft_size=0, exposure=1),
    "sphere": dict(kind="POINT", energy=2, shadow_soft_size=0.05, use_soft_falloff=False),
    "not normalised": dict(kind="POINT", energy=200, shadow_soft_size=0.05, use_soft_falloff=False, normalize=False),
    "spot": dict(kind="SPOT", energy=2, shadow_soft_size=0, spot_size=2.4, spot_blend=0.1, use_temperature=True, temperature=3000),
    "area": dict(kind="AREA", energy=1, shape="RECTANGLE", size=0.3, size_y=0.1),
}
for name, values in LAMPS.items():
    made = lamp(place=at, **values)
    bpy.context.view_layer.update()
    bpy.ops.relit.relight()
    for each in [each for each in scene.objects if "relit_card" in each]:
        bpy.data.objects.remove(each)
    os.replace(folder + "/shaded_frames/frame.0001.exr", folder + f"/{name} shaded.exr")
    render(folder + f"/{name}.exr", 64, bounces=0)
    found[name] = lights.distant(made, lights.subject_of(root))
    bpy.data.objects.remove(made)

found["refused"] = []
for values in (dict(kind="SPOT", spot_size=0.1), dict(kind="AREA", spread=1.0), dict(kind="POINT", use_shadow=False),
               dict(kind="POINT", specular_factor=0.0), dict(kind="AREA", shape="DISK")):
    made = lamp(place=at, **values)
    bpy.context.view_layer.update()
    found["refused"].append(refused(bpy.ops.relit.relight))
    bpy.data.objects.remove(made)
found["dark"] = refused(bpy.ops.relit.relight)
root.scale = (1, 2, 1)
bpy.context.view_layer.update()
found["stretched"] = refused(bpy.ops.relit.relight)
"""


@pytest.fixture
def a_ball(tmp_path) -> SurfaceMaps:
    """A Lambertian ball before a turned perspective camera, as maps, asset and capture in the test's folder."""
    camera, radius, centre_z = CAMERAS["perspective, turned"]
    maps = ball(camera, radius, centre_z)
    maps = SurfaceMaps(camera=camera, mask=maps.mask, normal=maps.normal, diffuse_albedo=maps.diffuse_albedo, height=maps.height)
    (tmp_path / "maps").mkdir()
    maps.write(tmp_path / "maps" / MAPS_FILE)
    write_exr(tmp_path / "sky.exr", uneven())
    capture = capture_of(tmp_path / "capture", camera, [{"type": "distant", "direction": [0.6, 0, 0.8], "irradiance": [3, 3, 3]}])
    assert capture.camera == camera
    export(ExportRequest(maps=tmp_path / "maps", out=tmp_path / "asset.usda", environment=tmp_path / "sky.exr", rig=tmp_path / "capture"))
    return maps


def test_lights_of_blender_are_those_that_relit_shades_with(a_ball, tmp_path):
    at = (0.25, 0.3, -0.25)
    found = in_blender(NEAR, tmp_path, capture=tmp_path / "capture", at=at)
    inside = binary_erosion(a_ball.mask, np.ones((3, 3)))
    normal = a_ball.normal.astype(float)
    for name in ("sun", "point", "sphere", "not normalised", "spot", "area"):
        rendered, shaded = (picture(tmp_path / f"{name}{suffix}.exr")[..., :3] for suffix in ("", " shaded"))
        ratio = rendered[inside].sum(axis=0) / shaded[inside].sum(axis=0)
        np.testing.assert_allclose(ratio, 1, atol=0.02, err_msg=name)  # a mesh of flat facets, and noise of 64 paths
        assert compare(rendered, shaded, inside, scaled=False).rmse < 0.05, name
    sun = found["sun"]
    np.testing.assert_allclose([*sun["irradiance"], sun["angle_degrees"]], [3, 1.5, 0.75, np.degrees(0.2)], rtol=1e-5)
    distant = a_ball.diffuse_albedo / np.pi * np.maximum(normal @ sun["direction"], 0)[..., None] * sun["irradiance"]
    assert compare(picture(tmp_path / "sun.exr")[..., :3], distant, inside, scaled=False).rmse < 0.05
    points = a_ball.camera.points(a_ball.height)[a_ball.mask]
    distance = 1.5 * np.linalg.norm(np.array(at) - (points.min(axis=0) + points.max(axis=0)) / 2)
    # E = Φ/4πd², in W and metres, with an exposure of one stop; the mesh ends half a pixel outside the mask
    np.testing.assert_allclose(found["point"]["irradiance"], 2 * 2 / (4 * np.pi * distance**2), rtol=0.05)
    spot, spread, shadow, factor, disk = found["refused"]
    assert "cone of the light SPOT falls on the object" in spot and "spread below 180" in spread and "no shadow" in shadow
    assert "factor" in factor and "is a disk" in disk and "no light" in found["dark"] and "stretches no object" in found["stretched"]


WORLD = """
import importlib
environment = importlib.import_module(NAME + ".environment")
from pathlib import Path
folder, environment.HEIGHT = Path(given["folder"]), 128
settings(capture=given["capture"], out=str(folder), asset=str(folder / "asset.usda"))
bpy.ops.relit.import_asset()
scene = bpy.context.scene
found["no card"] = refused(bpy.ops.relit.compare_render)
found["captured"] = [scene.world is None, scene.relit.light]
settings(light="ENVIRONMENT")
render(folder / "environment.exr", 256, bounces=0)
found["file"] = str(environment.write_world(scene, scene.relit.root, range(3, 5), folder / "worlds"))
scene.world.node_tree.nodes["Background"].inputs["Strength"].keyframe_insert("default_value", frame=3)
scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 2
scene.world.node_tree.nodes["Background"].inputs["Strength"].keyframe_insert("default_value", frame=4)
found["files"] = str(environment.write_world(scene, scene.relit.root, range(3, 5), folder / "worlds"))
bpy.ops.relit.show_frames(filepath=str(folder / "frames" / "frame.0002.exr"))
scene.world = None
for each in scene.objects:
    each.hide_render = each.type == "MESH" and "relit_card" not in each
for number in (1, 2):
    scene.frame_set(number)
    render(folder / f"card{number}.exr", 4)
found["scenes"] = len(bpy.data.scenes)

from bpy_extras.object_utils import world_to_camera_view
settings(place="BESIDE")
bpy.ops.relit.show_frames(filepath=str(folder / "frames" / "frame.0001.exr"))
card, = [each for each in scene.objects if "relit_card" in each]
bpy.context.view_layer.update()
found["beside"] = [tuple(world_to_camera_view(scene, scene.camera, card.matrix_world @ each.co))[:2] for each in card.data.vertices]
for _ in range(2):
    bpy.ops.relit.compare_render()
    editors = [each for each in bpy.context.window_manager.windows[0].screen.areas if each.type == "IMAGE_EDITOR"]
    found["editors"] = [[each.spaces.active.image.type, each.spaces.active.image.name, each.spaces.active.image_user.frame_start]
                        for each in sorted(editors, key=lambda each: each.x)]
found["other kinds"] = []
for name in ("asset.usdz", "asset.glb"):
    settings(asset=str(folder / name))
    bpy.ops.relit.import_asset()
    found["other kinds"].append([bpy.context.scene.relit.light, sum(each.type == "MESH" for each in bpy.context.scene.objects)])
settings(mesh="lod1")
found["no variants"] = refused(bpy.ops.relit.import_asset)
settings(mesh="mesh", capture=given["other"], asset=str(folder / "asset.usdz"))
found["another capture"] = refused(bpy.ops.relit.import_asset)

# photographs of the same ball under a dome, relit under the world of which Blender's render is there already
environment.HEIGHT = 64
settings(capture=given["dome"], out=str(folder / "lit"), asset=str(folder / "asset.usda"))
bpy.ops.relit.import_asset()
bpy.context.scene.frame_start = bpy.context.scene.frame_end = 1
settings(light="ENVIRONMENT", method="RELIGHT", guided=False)
bpy.ops.relit.relight()
"""


def test_a_world_is_the_environment_and_is_written_as_it_was(a_ball, tmp_path):
    write_frames(tmp_path / "frames", (1, 2), a_ball.camera, opaque=True)
    for suffix in (".usdz", ".glb"):
        export(ExportRequest(maps=tmp_path / "maps", out=tmp_path / f"asset{suffix}", name="Ball"))
    capture_of(tmp_path / "other", a_ball.camera.model_copy(update={"focal_px": (50.0, 50.0)}), [{"type": "off"}])
    dome = fibonacci_sphere(DOME_LIGHTS)
    capture_of(tmp_path / "dome", a_ball.camera, [{"type": "distant", "direction": list(each), "irradiance": [3, 3, 3]} for each in dome],
               color_space="lin_rec709_scene")
    for index, each in enumerate(dome):
        shading = np.maximum(a_ball.normal.astype(float) @ each, 0)[..., None]
        write_exr(tmp_path / "dome" / f"{index:03d}.exr", 3 / np.pi * a_ball.diffuse_albedo * shading * a_ball.mask[..., None])
        edit_frame(tmp_path / "dome", index, image=f"{index:03d}.exr")
    found = in_blender(WORLD, tmp_path, capture=tmp_path / "capture", other=tmp_path / "other", dome=tmp_path / "dome")
    assert found["captured"] == [True, "CAPTURED"]
    d, omega = directions(64)
    cosine = np.maximum(np.einsum("rcx,hwx->rchw", a_ball.normal.astype(float), d), 0)
    truth = a_ball.diffuse_albedo / np.pi * np.einsum("rchw,hwk,hw->rck", cosine, uneven(), omega)
    inside = binary_erosion(a_ball.mask, np.ones((3, 3)))
    assert compare(picture(tmp_path / "environment.exr")[..., :3], truth, inside, scaled=False).rmse < 0.05  # noise of 256 paths
    relit, rendered = (picture(tmp_path / name)[..., :3] for name in ("lit/relit_frames/frame.0001.exr", "environment.exr"))
    # a fifth of a steradian for each light of the dome, and the noise of Blender's 256 paths
    assert compare(relit, rendered, inside, scaled=False).rmse < 0.05
    written = {name: exr.read(tmp_path / "worlds" / f"{name}.exr")[0] for name in ("world", "world.0003", "world.0004")}
    maps = {name: np.stack([found[channel] for channel in "RGB"], axis=-1).reshape(64, 2, 128, 2, 3).mean(axis=(1, 3))
            for name, found in written.items()}
    # Blender interpolates between the texels of 2.8 degrees, and between the top and the bottom row
    np.testing.assert_allclose(maps["world"][1:-1], uneven()[1:-1], rtol=0.05)
    np.testing.assert_allclose(maps["world.0003"], maps["world"], rtol=0.02)
    np.testing.assert_allclose(maps["world.0004"], 2 * maps["world"], rtol=0.02)
    assert found["file"].endswith("world.exr") and found["files"].endswith("world.####.exr") and found["scenes"] == 2
    for number in (1, 2):
        card = picture(tmp_path / f"card{number}.exr")
        np.testing.assert_allclose(card[1:-1, 1:-1], np.broadcast_to([number / 4, 0.5, 2, 1], (30, 30, 4)), rtol=1e-3)
    np.testing.assert_allclose(found["beside"], [(1.05, 0), (2.05, 0), (2.05, 1), (1.05, 1)], atol=1e-4)
    assert "there are no frames yet" in found["no card"]
    (kind, *_), (_, name, first) = found["editors"]  # Blender's render at the left, and at the right the frames of the card
    assert (kind, name, first) == ("RENDER_RESULT", "frame.0001.exr", 1)
    assert found["other kinds"] == [["CAPTURED", 1], ["CAPTURED", 1]]  # the rig of asset.usda lies beside them too
    assert "has no mesh 'lod1'" in found["no variants"] and "different cameras" in found["another capture"]


STAGED = """
import importlib
from pathlib import Path
from mathutils import Matrix
environment, lights = (importlib.import_module(f"{NAME}.{name}") for name in ("environment", "lights"))
environment.HEIGHT, folder = 32, Path(given["folder"])
settings(capture=given["capture"], out=str(folder), asset=str(folder / "asset.usda"), guided=False)
held = set(bpy.data.user_map())
settings(mesh="lod4")
refused(bpy.ops.relit.import_asset)
found["left"] = [each.name for each in set(bpy.data.user_map()) - held]
settings(mesh="mesh")
bpy.ops.relit.import_asset()
scene, root = bpy.context.scene, bpy.context.scene.relit.root
settings(light="SCENE")

# lights that Blender does not render, and those that Relit cannot follow
def collection(name, parent):
    made = bpy.data.collections.new(name)
    parent.children.link(made)
    return made

def lamp(name, home=scene.collection, kind="POINT"):
    made = bpy.data.objects.new(name, bpy.data.lights.new(name, kind))
    home.objects.link(made)
    return made

hidden, excluded = collection("hidden", scene.collection), collection("excluded", scene.collection)
lamp("below", collection("inner", hidden))
lamp("excluded", excluded)
lamp("portal", kind="AREA").data.cycles.is_portal = True
lamp("shines")
hidden.hide_render = True
bpy.context.view_layer.layer_collection.children["excluded"].exclude = True
found["shining"] = [each.name for each in lights.shining(bpy.context)]
found["refused"] = []
unseen, linked, off = lamp("unseen"), lamp("linked"), lamp("off")
unseen.visible_diffuse, linked.light_linking.receiver_collection, off.hide_viewport = False, hidden, True
instances = bpy.data.objects.new("instances", None)
instances.instance_type, instances.instance_collection = "COLLECTION", bpy.data.collections.new("instanced")
lamp("copied", instances.instance_collection)
scene.collection.objects.link(instances)
several = instances, off, linked, unseen
for each in several:
    for other in several:
        other.hide_render = other is not each
    found["refused"].append(refused(bpy.ops.relit.relight))
unseen.hide_render = True

# a turntable: the camera frame turns by 180 degrees about its y under a world that stays
scene.world = scene.relit.environment
root.rotation_mode = "QUATERNION"
start = root.matrix_world.copy()
for frame, angle in ((1, 0), (2, 3.141592653589793)):
    root.matrix_world = start @ Matrix.Rotation(angle, 4, "Y")
    root.keyframe_insert("rotation_quaternion", frame=frame)
found["turned"] = environment.write_world(scene, root, range(1, 3), folder / "turned").name
preferences.backend, preferences.url = "SERVICE", "http://127.0.0.1:1"
scene.frame_start, scene.frame_end = 1, 2
found["service"] = refused(bpy.ops.relit.relight)
root.animation_data_clear()
found["still"] = environment.write_world(scene, root, range(1, 3), folder / "still").name
group = bpy.data.node_groups.new("group", "ShaderNodeTree")
group.nodes.new("ShaderNodeValue").outputs[0].keyframe_insert("default_value", frame=1)
scene.world.node_tree.nodes.new("ShaderNodeGroup").node_tree = group
found["group"] = environment.write_world(scene, root, range(1, 2), folder / "group").name
scene.world.node_tree.nodes.new("ShaderNodeLightPath")
found["rays"] = refused(bpy.ops.relit.relight)

first = folder / "frames" / "frame.0001.exr"
def shown():
    bpy.ops.relit.show_frames(filepath=str(first))
    return [len(bpy.data.meshes), len(bpy.data.materials)], bpy.data.images[first.name].source

found["cards"] = [shown(), shown()]
(folder / "frames" / "frame.0002.exr").unlink()
found["cards"].append(shown())
"""


def test_what_is_lit_is_what_blender_would_render_and_the_rest_is_refused(a_ball, tmp_path):
    write_frames(tmp_path / "frames", (1, 2), a_ball.camera, opaque=True)
    found = in_blender(STAGED, tmp_path, capture=tmp_path / "capture")
    assert found["left"] == [] and found["shining"] == ["shines"]
    instances, off, linked, unseen = found["refused"]
    assert "instances makes instances of lights" in instances and "off is disabled in viewports" in off
    assert "the light linked has light linking" in linked and "the light unseen has rays that do not see it" in unseen
    assert [found["turned"], found["still"], found["group"]] == ["world.####.exr", "world.exr", "world.####.exr"]
    one, other = (exr.read(tmp_path / "turned" / f"world.000{number}.exr")[0]["G"] for number in (1, 2))
    # half a turn about the axis of the map; noise of 32 paths, and rows at the poles that Blender blends
    np.testing.assert_allclose(other[2:-2], np.roll(one, one.shape[1] // 2, axis=1)[2:-2], rtol=0.1)
    assert "camera frame turns" in found["service"] and "Light Path" in found["rays"]
    (before, sequence), again, (after, single) = found["cards"]
    assert again == [before, sequence] and after == before and [sequence, single] == ["SEQUENCE", "FILE"]
