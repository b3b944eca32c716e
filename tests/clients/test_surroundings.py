"""Blender, as it imports what an asset brings along: lights when asked for, cameras that frame the image, and the replay of the docs."""

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from benchmarks.clients import installed
from benchmarks.clients.render import TIME_LIMIT_S, Client
from service.asset.usd.asset import write_asset
from service.asset.usd.surroundings import Surroundings
from tests.clients.programs import require
from tests.scenes.surfaces import make_wave
from tests.scenes.surroundings import capture_of

pytestmark = pytest.mark.long

DOCS = Path(__file__).parents[2] / "docs" / "export.md"
IMPORT = """
import bpy, json, sys
from bpy_extras.object_utils import world_to_camera_view
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.resolution_x, scene.render.resolution_y = 30, 20
for path in sys.argv[1:]:
    bpy.ops.wm.usd_import(filepath=path)
bpy.context.view_layer.update()
found = {"lights": sorted(light.name for light in bpy.data.lights), "pixels": {}}
for mesh in [each for each in bpy.data.objects if each.type == "MESH"]:
    for camera in [each for each in bpy.data.objects if each.type == "CAMERA"]:
        seen = [world_to_camera_view(scene, camera, mesh.matrix_world @ vertex.co) for vertex in mesh.data.vertices]
        found["pixels"][camera.name] = [(place.x * 30, 20 - place.y * 20) for place in seen]
    found["st"] = [(0, 0)] * len(mesh.data.vertices)
    for loop, st in zip(mesh.data.loops, mesh.data.uv_layers[0].data):
        found["st"][loop.vertex_index] = tuple(st.uv)
"""
REPORT = """
found["replayed"] = []
for frame in (1, 2, 3):
    scene.frame_set(frame)
    lit = {light.name: (light.energy, light.type) for light in bpy.data.lights if light.energy}
    towards = {each.name: tuple(each.matrix_world.to_3x3() @ __import__("mathutils").Vector((0, 0, 1)))
               for each in bpy.data.objects if each.type == "LIGHT"}
    found["replayed"].append({name: (*facts, *towards[name]) for name, facts in lit.items()})
print("FOUND" + json.dumps(found))
"""


def in_blender(*assets: Path, script: str = "") -> dict:
    """What Blender has after it imported the assets one after the other, and ran a script."""
    require(Client.BLENDER)
    python = installed.python_with("bpy", "RELIT_TEST_BLENDER_PYTHON")
    done = subprocess.run([python, "-P", "-c", IMPORT + script + REPORT, *assets], capture_output=True, text=True, timeout=TIME_LIMIT_S)
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    return json.loads(re.search("FOUND(.*)", done.stdout)[1])


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_lights_are_replayed_where_they_are_asked_for_alone(suffix, tmp_path):
    maps = make_wave("orthographic", pixel_size_m=0.01)
    lights = [{"type": "distant", "direction": [0.6, 0, 0.8], "irradiance": [3, 3, 3]},
              {"type": "point", "position_m": [0.1, 0.2, 0.5], "intensity": [2, 1, 1]}, {"type": "off"}]
    capture = capture_of(tmp_path / "capture", maps.camera, lights)
    write_asset(maps, tmp_path / f"a{suffix}", name="A", surroundings=Surroundings(rig=capture))
    alone = in_blender(tmp_path / f"a{suffix}")
    assert alone["lights"] == []
    wanted = np.array(alone["st"]) * (30, -20) + (0, 20)
    np.testing.assert_allclose(alone["pixels"]["CameraPerspective"], wanted, atol=0.1)  # 0.05 of parallax, and float32
    assert np.abs(np.array(alone["pixels"]["Camera"]) - wanted).max() > 5  # once Blender frames it right, the docs may say so

    replay, = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8").partition("## Lights")[2], re.S)
    both = in_blender(tmp_path / f"a{suffix}", tmp_path / "a_lights" / "rig.usda", script=replay)
    assert both["lights"] == ["Light_0001", "Light_0002"]
    first, second, third = both["replayed"]
    energy, kind, *direction = first.pop("Light_0001")
    assert (energy, kind) == (pytest.approx(3), "SUN") and not first  # a sun's energy is its irradiance
    np.testing.assert_allclose(direction, (0.6, -0.8, 0), atol=1e-6)  # Blender's z is up: (x, y, z) becomes (x, -z, y)
    energy, kind, *_ = second.pop("Light_0002")
    assert (energy, kind) == (pytest.approx(4 * np.pi * 2), "POINT") and not second and not third  # a power: 4 pi times its intensity
