"""The shipped owl by the operators of the panel: solved, imported, rendered, relit under a sun of the scene, and shown on a card."""

import json
import shutil

import numpy as np
import pytest

from benchmarks.clients.comparison import compare
from benchmarks.clients.panel import picture
from stage.capture.capture import Capture
from stage.stack.correction import Correction
from tests.clients.blender import in_blender
from tests.service.owl import OWL

pytestmark = pytest.mark.long

OWL_LIGHTS = (44, 31)
"""The light of the owl that is nearest to the view axis, and one 20 degrees from it."""

THE_OWL = """
from mathutils import Vector
settings(capture=given["capture"], levels=1)
bpy.ops.relit.solve()
scene, chosen = bpy.context.scene, bpy.context.scene.relit
found["light"], found["resolution"] = chosen.light_index, (scene.render.resolution_x, scene.render.resolution_y)
render(given["folder"] + "/owl.exr", 24)
def held():
    return [len(each) for each in (bpy.data.scenes, bpy.data.objects, bpy.data.collections)]

before = held()
settings(mesh="lod4")
found["no level"] = refused(bpy.ops.relit.import_asset)
found["left"] = before == held()
settings(mesh="lod1", look="specular")
bpy.ops.relit.import_asset(new_scene=False)
found["meshes"] = sorted(len(each.data.polygons) for each in scene.objects if each.type == "MESH")
found["materials"] = sorted(slot.name for each in scene.objects for slot in each.material_slots)

# a sun of the scene that goes from one captured light to another
bpy.ops.relit.import_asset(new_scene=True)
scene = bpy.context.scene
settings(mesh="mesh", look="metallic", light="SCENE", guided=False)
sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
sun.data.energy, sun.data.angle, sun.rotation_mode = 3, 0, "QUATERNION"
scene.collection.objects.link(sun)
for frame, (x, y, z) in zip((2, 4), given["directions"]):
    sun.rotation_quaternion = Vector((x, -z, y)).to_track_quat("Z", "Y")
    sun.keyframe_insert("rotation_quaternion", frame=frame)
scene.frame_start, scene.frame_end = 2, 4
bpy.ops.relit.relight()
bpy.data.objects.remove(sun)
for each in scene.objects:
    each.hide_render = each.type == "MESH" and "relit_card" not in each
scene.frame_set(4)
render(given["folder"] + "/card.exr", 1)
"""


def test_the_owl_from_the_panel_looks_like_its_photographs(tmp_path):
    """Error of the rendered asset: RMSE over the photograph's mean, all pixels of the mask, no factor of brightness; the bar is .15."""
    folder = shutil.copytree(OWL, tmp_path / "owl", ignore=shutil.ignore_patterns(".relit"))
    capture = Capture.open(folder)
    correction, mask, sources = Correction.of(capture), capture.mask(), list(capture.sources())
    photographs = [correction.apply(sources[index]).pixels for index in OWL_LIGHTS]
    lights = [frame["light"]["direction"] for frame in json.loads((folder / "capture.json").read_text())["frames"]]
    found = in_blender(THE_OWL, tmp_path, capture=folder, directions=[lights[index] for index in OWL_LIGHTS])
    assert found["light"] == OWL_LIGHTS[0] and found["resolution"] == [320, 320]
    assert compare(picture(tmp_path / "owl.exr")[..., :3], photographs[0], mask, scaled=False).rmse < 0.15
    assert found["no level"].startswith("asset.usda has no mesh 'lod4'") and found["left"]
    assert found["meshes"][0] < 0.6 * found["meshes"][1] and any("Specular" in name for name in found["materials"])
    for number, photograph in zip((2, 4), photographs, strict=True):
        frame = picture(tmp_path / "owl_relit" / "relit_frames" / f"frame.{number:04d}.exr")
        # a captured light gives its photograph; Blender keeps directions in float32, of whose 1e-7 the weights make less than a percent
        assert compare(frame[..., :3], photograph, mask, scaled=False).rmse < 0.01
    card = picture(tmp_path / "card.exr")
    # the last frame, since the sequence is shown at frame 4; Cycles' filter of 1.5 pixels blurs it
    assert np.abs(card - frame).max() < 0.02 * frame.max()
