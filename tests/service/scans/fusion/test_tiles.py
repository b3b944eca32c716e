"""relit fuse --tiles: the same surface as in one mesh, to the last bit, in tiles that meet without cracks."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from service.asset.usd.fused_asset import Tile, write_site
from service.requests.register import FuseRequest
from service.scans.fusion import fused_bricks
from service.scans.fusion.fuse import FuseResult, fuse
from service.scans.points.ply_points import read_ply_points
from tests.scenes.register import fuse_scans
from tests.scenes.statue import turntable, write_scans
from tests.service.scans.mesh_files import read_faces

pytestmark = pytest.mark.long  # its fixture takes six seconds

VOXEL = 3e-3
"""A brick is 0.77 m: the statue lies in several."""


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> tuple[FuseResult, FuseResult]:
    folder = tmp_path_factory.mktemp("tiles")
    file = write_scans(folder, turntable(5, (128, 96)), coloured=True)
    whole, tiled = (fuse_scans(file, folder / str(tiles), voxel_m=VOXEL, tiles=tiles, close="none") for tiles in (False, True))
    return whole, tiled


def vertices(path) -> np.ndarray:
    ply = read_ply_points(path)
    return np.concatenate([ply.points, ply.normals, ply.colours, ply.sigma[:, None]], axis=1)


def test_tiles_hold_the_vertices_and_faces_of_the_mesh(both):
    whole, tiled = both
    parts = sorted((tiled.report_path.parent / "tiles").glob("*.ply"))
    assert len(parts) == tiled.facts["tiles"] > 3
    found = [vertices(path) for path in parts]
    mesh = vertices(whole.mesh_path)
    assert tiled.facts["vertices"] == len(mesh) < sum(map(len, found))  # vertices on shared faces are in several tiles
    np.testing.assert_array_equal(np.unique(np.concatenate(found), axis=0), np.unique(mesh, axis=0))
    corners = [given[:, :3][read_faces(path)].reshape(-1, 9) for given, path in zip(found, parts, strict=True)]
    expected = mesh[:, :3][read_faces(whole.mesh_path)].reshape(-1, 9)
    np.testing.assert_array_equal(np.unique(np.concatenate(corners), axis=0), np.unique(expected, axis=0))


def test_the_report_says_the_same(both):
    whole, tiled = both
    for key in ("faces", "vertices", "voxel_m", "scans", "area_share_seen_by", "blocks", "bricks"):
        assert tiled.facts[key] == whole.facts[key], key
    assert tiled.facts["open_edges"] == whole.facts["holes"]["open_edges"]
    assert tiled.facts["area_m2"] == pytest.approx(whole.facts["area_m2"], rel=1e-6)
    assert tiled.facts["open_length_m"] == pytest.approx(whole.facts["holes"]["open_length_m"], rel=1e-3)
    assert tiled.facts["sigma_m"]["median"] == pytest.approx(whole.facts["sigma_m"]["median"], rel=0.01)  # bins are half a per cent wide


def test_usd_loads_the_tiles_that_are_asked_for(both):
    _, tiled = both
    empty = Usd.Stage.Open(str(tiled.asset_path), Usd.Stage.LoadNone)
    places = empty.GetDefaultPrim().GetAllChildren()  # GetChildren leaves out what is not loaded
    assert len(places) == tiled.facts["tiles"] and not any(prim.IsA(UsdGeom.Mesh) for prim in empty.Traverse())
    empty.Load(places[0].GetPath())
    mesh, = [UsdGeom.Mesh(prim) for prim in empty.Traverse() if prim.IsA(UsdGeom.Mesh)]
    hint = np.array(UsdGeom.ModelAPI(places[0]).GetExtentsHintAttr().Get())
    points = np.array(mesh.GetPointsAttr().Get())
    np.testing.assert_array_equal(hint[:2], [points.min(axis=0), points.max(axis=0)])
    assert len(mesh.GetDisplayColorAttr().Get()) == len(points)


def test_a_fusion_that_was_interrupted_goes_on(tmp_path, monkeypatch):
    file = write_scans(tmp_path, turntable(3, (64, 48)))
    request = FuseRequest(scan_set=file, out=tmp_path / "out", voxel_m=6e-3, texture=False, cache=tmp_path / "cache", device="cpu")
    first = fuse(request).mesh_path.read_bytes()
    lost = sorted((tmp_path / "cache").rglob("*-fuse-*/000000*"))
    for path in lost:
        path.unlink()
    bricks, fuse_brick = [], fused_bricks.fuse_brick
    monkeypatch.setattr(fused_bricks, "fuse_brick", lambda brick, *given, **options: bricks.append(brick) or fuse_brick(
        brick, *given, **options))
    assert fuse(request).mesh_path.read_bytes() == first and len(bricks) == 1 and lost


def test_usd_complains_of_nothing(tmp_path, capfd):
    point = np.zeros(3)
    write_site([Tile(tmp_path / "tiles" / "0_0_0.usdc", point, point)], tmp_path / "site.usda", name="site", provenance={})
    assert capfd.readouterr() == ("", "") and (tmp_path / "site.usda").exists()


def test_options_of_textures_are_refused_with_tiles(tmp_path):
    with pytest.raises(ValueError, match="texture_px: is given with tiles"):
        FuseRequest(scan_set=tmp_path, out=tmp_path, tiles=True, texture_px=512)
