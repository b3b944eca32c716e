"""Blender shows the steps of a sequence at their time codes, with faces that come and go."""

import json
import subprocess

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from benchmarks.clients import installed
from benchmarks.clients.render import Client
from service.asset.usd.layers import Description
from service.asset.usd.sequence_asset import Faces, Moment, write_sequence_asset
from stage.capture.camera import Camera
from tests.clients.programs import require

pytestmark = pytest.mark.long

SCRIPT = """
import json, sys
import bpy
import numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=sys.argv[1])
seen = [each for each in bpy.data.objects if each.type in ("MESH", "POINTCLOUD")][0]
found = {}
for frame in (0, 2, 5):
    bpy.context.scene.frame_set(frame)
    data = seen.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    places = data.vertices if seen.type == "MESH" else data.points
    flat = np.empty(3 * len(places), np.float32)
    places.foreach_get("co", flat)
    found[frame] = flat.reshape(-1, 3).tolist()
print("FOUND " + json.dumps(found))
"""


def moments(faces: bool):
    for time, count in ((0, 4), (2, 5), (5, 3)):
        points = np.random.default_rng(time).random((count * count, 3)).astype(np.float32)
        corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
        around = np.stack([corner, corner + count, corner + count + 1, corner + 1], axis=1).ravel()
        yield Moment(time, points, points, np.tile(np.float32([0, 0, 1]), (len(points), 1)) if faces else None,
                     Faces(np.full(len(corner), 4), around) if faces else None, None if faces else np.full(len(points), 0.01, np.float32))


@pytest.mark.parametrize("suffix", ["usdc", "usdz"])
@pytest.mark.parametrize("faces", [True, False], ids=["mesh", "points"])
def test_blender_shows_each_step(faces, suffix, tmp_path):
    require(Client.BLENDER)
    asset = tmp_path / f"walk.{suffix}"
    camera = Camera(projection="orthographic", resolution=(8, 8), pixel_size_m=0.1)
    write_sequence_asset(moments(faces), asset, Description("walk", camera, {}), frames_per_second=24)
    python = installed.python_with("bpy", "RELIT_TEST_BLENDER_PYTHON")
    told = subprocess.run([python, "-c", SCRIPT, asset], capture_output=True, text=True, check=True, timeout=300).stdout
    found = json.loads(next(line for line in told.splitlines() if line.startswith("FOUND "))[6:])
    usd_stage = Usd.Stage.Open(str(asset))
    based = UsdGeom.PointBased(usd_stage.GetPrimAtPath(f"/walk/Geom/{'Mesh' if faces else 'Points'}"))
    for time in (0, 2, 5):
        np.testing.assert_allclose(found[str(time)], np.array(based.GetPointsAttr().Get(time)), atol=1e-6)
