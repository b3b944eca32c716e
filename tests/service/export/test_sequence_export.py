"""Results of a sequence as one time-sampled USD asset: what each time code shows, what is refused, and how much memory it takes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade

from service.errors import AssetError, RequestError
from service.export.export import export
from service.requests.depth import DepthRequest
from service.requests.export import ExportRequest, Geometry, TextureFormat
from service.requests.solve import Method, SolveRequest
from service.sequences.run import depth_sequence, solve_sequence
from stage.errors import ResultError
from stage.results.maps import SurfaceMaps
from tests.clients.validators import findings
from tests.scenes import depth as depths
from tests.scenes.captures import edit_manifest, write_image
from tests.scenes.sequence import write_sequence

TIMES = [0.0, 0.1, 0.3]
"""At 30 a second the time codes 0, 3 and 9."""


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Three solved steps, of which the second has a smaller mask."""
    folder = tmp_path_factory.mktemp("walk")
    write_sequence(folder / "in", [None, 10, 14], size=28, times=TIMES)
    mask = np.zeros((28, 28), np.uint8)
    mask[3:25, 3:20] = 255
    write_image(folder / "in" / "step01" / "mask.png", mask)
    edit_manifest(folder / "in" / "step01", mask="mask.png")
    solve_sequence(SolveRequest(capture=folder / "in", out=folder / "out", method=Method.LAMBERT, device="cpu"))
    return folder / "out"


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    patterns = [*depths.BLACK_WHITE, *depths.phase_patterns("column", 16), *depths.gray_patterns("column", stripe=16)]
    for step in range(2):
        scene = depths.make_scene(centre=(-0.1 + 0.1 * step, 0, -1.35))
        depths.write_patterns(folder / "in" / f"s{step}", scene, patterns, noise=0.002, seed=step)
    depth_sequence(DepthRequest(capture=folder / "in", out=folder / "out", device="cpu"))
    return folder / "out"


def exported(folder, out, **options):
    return export(ExportRequest(maps=folder, out=out, name="Walk 1", **options))


@pytest.mark.long
@pytest.mark.parametrize("suffix", ["usdc", "usdz"])
def test_each_time_code_shows_its_step(walk, tmp_path, suffix):
    found = exported(walk, tmp_path / f"walk.{suffix}")
    assert list(found.sizes) == ["3 steps"]
    usd_stage = Usd.Stage.Open(str(found.path))
    assert (usd_stage.GetTimeCodesPerSecond(), usd_stage.GetStartTimeCode(), usd_stage.GetEndTimeCode()) == (30, 0, 9)
    mesh = UsdGeom.Mesh.Get(usd_stage, "/Walk_1/Geom/Mesh")
    times = [0.0, 3.0, 9.0]
    colour = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("displayColor")
    for attribute in (mesh.GetPointsAttr(), mesh.GetNormalsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetExtentAttr(), colour.GetAttr()):
        assert attribute.GetTimeSamples() == times
    counts = []
    for step, time in enumerate(times):
        maps = SurfaceMaps.read(walk / f"step{step:02d}" / "maps.exr")
        points, normals = (np.array(attribute.Get(time)) for attribute in (mesh.GetPointsAttr(), mesh.GetNormalsAttr()))
        colours = np.array(colour.ComputeFlattened(time))
        assert len(points) == len(normals) == len(colours)
        corners, faces = mesh.GetFaceVertexIndicesAttr().Get(time), mesh.GetFaceVertexCountsAttr().Get(time)
        assert UsdGeom.Mesh.ValidateTopology(corners, faces, len(points))
        cols, rows = (np.floor(place).astype(int) for place in maps.camera.image_coordinates(points))
        inner = maps.mask[np.clip(rows, 0, 27), np.clip(cols, 0, 27)] & (rows > 0) & (rows < 27) & (cols > 0) & (cols < 27)
        centres = inner & (np.abs(points[:, 0] / 0.001 % 1 - 0.5) < 1e-3) & (np.abs(points[:, 1] / 0.001 % 1 - 0.5) < 1e-3)
        assert centres.sum() > 300
        at = rows[centres], cols[centres]
        np.testing.assert_allclose(points[centres, 2], maps.height[at], atol=1e-7)
        np.testing.assert_allclose(normals[centres], maps.normal[at], atol=1e-6)
        np.testing.assert_allclose(colours[centres], maps.diffuse_albedo[at], atol=1e-3)
        low, high = np.array(mesh.GetExtentAttr().Get(time))
        np.testing.assert_allclose([low, high], [points.min(axis=0), points.max(axis=0)])
        counts.append(len(points))
    assert counts[1] < counts[0] and len(mesh.GetPointsAttr().Get()) == counts[0]
    assert UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]


@pytest.mark.long
@pytest.mark.parametrize("suffix", ["usdc", "usdz"])
def test_validators_find_nothing(walk, scans, tmp_path, suffix):
    assert findings(exported(walk, tmp_path / f"walk.{suffix}").path) == []
    for geometry in Geometry:
        assert findings(exported(scans, tmp_path / f"{geometry}.{suffix}", geometry=geometry).path) == []


def test_points_of_depths_move(scans, tmp_path):
    found = exported(scans / "sequence.json", tmp_path / "scan.usdc", geometry=Geometry.POINTS)
    usd_stage = Usd.Stage.Open(str(found.path))
    points = UsdGeom.Points.Get(usd_stage, "/Walk_1/Geom/Points")
    assert UsdGeom.GetStageMetersPerUnit(usd_stage) == 1  # a depth is in metres, whether its camera knows how far the surface is or not
    assert points.GetPointsAttr().GetTimeSamples() == [0, 1] and usd_stage.GetTimeCodesPerSecond() == 24
    for time in (0, 1):
        assert len(points.GetPointsAttr().Get(time)) == len(points.GetWidthsAttr().Get(time)) > 5000


def test_what_is_refused(walk, tmp_path, relit):
    for options, words in (({"levels": 1}, "--levels: the asset of a sequence"),
                           ({"textures": TextureFormat.PNG8}, "--textures: the asset of a sequence"),
                           ({"rig": walk}, "--rig: lights and frames go with solved maps"),
                           ({"geometry": Geometry.POINTS}, "--geometry points: is for depths")):
        with pytest.raises(RequestError, match=words):
            exported(walk, tmp_path / "x.usdc", **options)
    for suffix in ("usda", "glb"):
        with pytest.raises(AssetError, match=r"suffix must be .usdc or .usdz"):
            exported(walk, tmp_path / f"x.{suffix}")
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "sequence.json").write_text(json.dumps({"schema": "relit.sequence/1", "steps": [{"path": "a"}]}))
    with pytest.raises(ResultError, match=r"a: holds neither maps.exr nor depth.exr"):
        exported(broken, tmp_path / "x.usdc")
    assert not any(tmp_path.glob("*.usd*")) and not any(tmp_path.glob(".x*"))
    assert "3 steps" in relit("export", walk, "--out", tmp_path / "walk.usdc").well()


SCRIPT = """
import resource, sys
from pathlib import Path
import numpy as np
from service.asset.usd.layers import Description
from service.asset.usd.sequence_asset import Faces, Moment, write_sequence_asset
from stage.capture.camera import Camera
rows, cols = np.indices((300, 300))
corner = (rows[:-1, :-1] * 300 + cols[:-1, :-1]).ravel()
faces = Faces(np.full(len(corner), 4), np.stack([corner, corner + 300, corner + 301, corner + 1], axis=1).ravel())
def moments():
    for step in range(int(sys.argv[1])):
        points = np.stack([cols, -rows, np.sin(cols / 30 + step)], axis=-1).reshape(-1, 3).astype(np.float32)
        yield Moment(step, points, np.random.default_rng(step).random(points.shape).astype(np.float32), points, faces, None)
camera = Camera(projection="orthographic", resolution=(300, 300), pixel_size_m=1.0)
write_sequence_asset(moments(), Path(sys.argv[2]), Description("m", camera, {}), frames_per_second=24)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
"""


@pytest.mark.long
def test_memory_does_not_grow_with_the_steps(tmp_path):
    """A step is 3.6 MB of points, normals and colours: 20 more would be 72 MB; the allocator's own changes are below 20."""
    home = Path(__file__).parents[3]
    few, many = (int(subprocess.run([sys.executable, "-c", SCRIPT, str(count), str(tmp_path / f"{count}.usdc")], cwd=home, text=True,
                                    capture_output=True, check=True).stdout) for count in (4, 24))
    assert many - few < 20
    assert (tmp_path / "24.usdc").stat().st_size > 50e6
