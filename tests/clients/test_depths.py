"""A measured depth shows what its camera saw, as it is imported: its texture under even light is the photograph."""

import numpy as np
import pytest

from benchmarks.clients.render import Client, Environment
from service.export.export import export
from service.requests.export import ExportRequest
from stage.capture.camera import Camera
from stage.formats.ply import POINTS_FILE, PointCloud, write_ply
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from tests.clients.programs import require
from tests.reference.colour import srgb_to_linear

pytestmark = pytest.mark.long

CAMERA = Camera(projection="perspective", resolution=(48, 36), focal_px=(50.0, 50.0), principal_px=(22.0, 20.0))
ROWS, COLS = np.indices((36, 48))
CODES = np.stack([60 + 4 * COLS, 230 - 5 * ROWS, np.full(ROWS.shape, 90)], axis=-1).astype(np.uint8)
WHITE = Environment(np.ones((16, 32, 3), np.float32))


@pytest.mark.parametrize("suffix", [".usdz", ".glb"])
@pytest.mark.parametrize("client", [Client.BLENDER, Client.THREE])
def test_a_depth_looks_like_its_photograph(client, suffix, programs, tmp_path):
    require(client)
    mask = (ROWS > 2) & ~((abs(ROWS - 20) < 4) & (abs(COLS - 12) < 5))  # a rim, and a hole
    depth = np.where(mask, 2 + 0.004 * COLS, 0).astype(np.float32)
    DepthMaps(camera=CAMERA, mask=mask, depth=depth).write(tmp_path / DEPTH_FILE)
    write_ply(PointCloud(CAMERA.points(-depth)[mask], CODES[mask]), tmp_path / POINTS_FILE)
    found = export(ExportRequest(maps=tmp_path, out=tmp_path / f"wall{suffix}", name="Wall"))
    assert not any("grey" in sentence for sentence in found.warnings)
    picture = programs.render(client, found.path, CAMERA, WHITE, samples=64)
    linear = srgb_to_linear(CODES / 255)
    inner = mask & (picture[..., 3] > 0.999)
    assert inner.sum() > 0.9 * mask.sum()
    ratio = picture[inner][:, :3] / linear[inner]
    # three.js adds the rim of a lobe of roughness 1; Blender's paths are noisy where the wall lights itself
    assert abs(np.median(ratio) - 1) < 0.03 and np.abs(ratio - 1).max() < 0.15
    assert picture[~mask & (ROWS > 18) & (ROWS < 22) & (abs(COLS - 12) < 2)][:, 3].max() < 0.01
