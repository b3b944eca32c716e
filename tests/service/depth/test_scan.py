"""relit scan: shots and waveforms to points.ply and points.usdc."""

import json
import subprocess
import sys

import laspy
import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade

from service.depth.scan import scan
from service.errors import RequestError
from service.requests.depth import ScanRequest
from stage.formats.ply import read_ply
from tests.clients.validators import findings
from tests.reference.tof import View, histogram


def write(folder, shots, **more):
    np.save(folder / "shots.npy", shots)
    (folder / "scan.json").write_text(json.dumps({"schema": "relit.scan/1", "name": "Yard 1", "shots": "shots.npy", **more}))
    return folder


def ring(n=360, range_m=5.0):
    azimuth = np.linspace(-np.pi, np.pi, n, endpoint=False)
    return np.stack([np.linspace(0, 1, n), azimuth, np.zeros(n), np.full(n, range_m), 10 + np.arange(n)], axis=1)


def test_a_turn_of_shots_is_a_ring(tmp_path):
    shots = ring()
    shots[5, 3], shots[6, 3] = np.nan, 0.0  # nothing came back
    result = scan(ScanRequest(scan=write(tmp_path, shots), out=tmp_path / "out", device="cpu"))
    cloud = read_ply(result.points_path)
    assert len(cloud.points) == 358 and result.counts["points"] == 358
    np.testing.assert_allclose(np.linalg.norm(cloud.points, axis=1), 5.0, rtol=1e-6)
    np.testing.assert_array_equal(cloud.intensity, np.delete(10 + np.arange(360), [5, 6]).astype(np.float32))
    usd_stage = Usd.Stage.Open(str(result.usd_path))
    prim = UsdGeom.Points(usd_stage.GetPrimAtPath(usd_stage.GetDefaultPrim().GetPath().AppendChild("Points")))
    np.testing.assert_array_equal(np.array(prim.GetPointsAttr().Get()), cloud.points)
    np.testing.assert_array_equal(np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("intensity").Get()), cloud.intensity)
    assert UsdGeom.GetStageMetersPerUnit(usd_stage) == 1.0
    low, high = np.array(prim.GetExtentAttr().Get())
    assert (low <= cloud.points.min(axis=0)).all() and (high >= cloud.points.max(axis=0)).all()
    report = json.loads(result.report_path.read_text())
    assert report["shots"]["with_points"] == 358


def test_points_on_a_map_are_counted_from_among_them(tmp_path):
    """Floats of 32 bits would hold them to half a metre."""
    place = [500123.5, 5400321.25, 312.0]
    track = [{"time_s": 0, "world_from_platform": [[*row, x] for row, x in zip(np.eye(3).tolist(), place, strict=True)] + [[0, 0, 0, 1]]}]
    result = scan(ScanRequest(scan=write(tmp_path, ring(), track=track), out=tmp_path / "out", device="cpu", las=True))
    origin = np.array(json.loads(result.report_path.read_text())["found"]["origin_m"])
    assert np.linalg.norm(read_ply(result.points_path).points + (origin - place), axis=1) == pytest.approx(5.0, abs=1e-6)
    assert np.linalg.norm(laspy.read(result.las_path).xyz - place, axis=1) == pytest.approx(5.0, abs=1e-4)  # its steps
    assert result.warnings == (f"the track lies so far from its origin that floats of 32 bits hold points to 0.5 m only: points.ply and "
                               f"points.usdc are counted from {','.join(f'{x:.0f}' for x in origin)}, points.las is not",)
    assert b"relit:origin_m" in result.points_path.read_bytes()


def test_the_asset_is_a_component_without_a_finding(tmp_path):
    shots = ring()
    shots[:, 4] = np.arange(360) % 7  # colours and intensities repeat
    folder = write(tmp_path, shots)
    (folder / "scan.json").write_text((folder / "scan.json").read_text().replace("Yard 1", "庭 1"))
    result = scan(ScanRequest(scan=folder, out=tmp_path / "out", device="cpu"))
    usd_stage = Usd.Stage.Open(str(result.usd_path))
    root = usd_stage.GetDefaultPrim()
    assert root.GetName().isascii() and root.GetName().endswith("_1") and root.GetDisplayName() == "庭 1"
    assert Usd.ModelAPI(root).GetKind() == "component" and Usd.ModelAPI(root).GetAssetName() == "庭 1"
    assert root.GetAssetInfoByKey("relit:capture") == usd_stage.GetMetadataByDictKey("customLayerData", "relit:capture") == "庭 1"
    points = UsdGeom.Points(root.GetChild("Points"))
    hint = np.array(UsdGeom.ModelAPI(root).GetExtentsHint())
    half = np.max(points.GetWidthsAttr().Get()) / 2
    assert half > 0 and np.allclose(hint, [result.cloud.points.min(axis=0) - half, result.cloud.points.max(axis=0) + half], atol=1e-6)
    assert (np.array(UsdGeom.PrimvarsAPI(points).GetPrimvar("intensity").ComputeFlattened()) == result.cloud.intensity).all()
    assert UsdShade.MaterialBindingAPI(points).ComputeBoundMaterial()[0]
    assert findings(result.usd_path) == []


def waveforms(folder, n, *, photons, scale=1, **more):
    """The waveforms of a turn of n shots whose surface goes from 2 m to 6 m away, `scale` units a photon."""
    view = View(np.linspace(2, 6, n)[None], np.full((1, n), 0.9), np.ones((1, n)))
    np.save(folder / "w.npy", scale * histogram(view, photons, seed=0, **more)[0])
    return write(folder, ring(n)[:, :3], waveforms={"file": "w.npy", "bin_s": 1.5e-9})


@pytest.mark.long
def test_waveforms_give_several_returns(tmp_path):
    n = 200
    result = scan(ScanRequest(scan=waveforms(tmp_path, n, photons=2e5, second=(2.5, 0.5)), out=tmp_path / "out", device="cpu"))
    distance = np.linalg.norm(result.cloud.points, axis=1)
    assert result.counts["points"] == 2 * n and result.counts["with_points"] == n
    wanted = np.concatenate([np.linspace(2, 6, n), np.linspace(2, 6, n) + 2.5])
    assert np.median(np.abs(np.sort(distance) - np.sort(wanted))) < 0.02


@pytest.mark.long
def test_scaled_waveforms_have_the_same_points_and_a_sentence(tmp_path):
    """Ten units a photon: taken for photons, noise of the background gives as many points again."""
    n = 400
    result = scan(ScanRequest(scan=waveforms(tmp_path, n, photons=4e3, scale=10, background=3.0), out=tmp_path / "out", device="cpu"))
    assert any("units were one photon" in sentence for sentence in result.warnings)
    assert json.loads(result.report_path.read_text())["warnings"] == list(result.warnings)
    assert result.counts["points"] == pytest.approx(n, rel=0.02)


def test_shots_outside_the_track_or_the_span_are_left_out_and_counted(tmp_path):
    still = np.eye(4).tolist()
    track = [{"time_s": 0, "world_from_platform": still}, {"time_s": 0.5, "world_from_platform": still}]
    shots = ring()
    shots[:10, 3] = 50.0
    folder = write(tmp_path, shots, track=track)
    result = scan(ScanRequest(scan=folder, out=tmp_path / "out", far_m=20, device="cpu"))
    assert result.counts["out_of_range"] == 10
    assert result.counts["outside_track"] == int((shots[:, 0] > 0.5).sum())
    with pytest.raises(RequestError, match="no shot gives a point"):
        scan(ScanRequest(scan=folder, out=tmp_path / "out", near_m=100, device="cpu"))


def test_las_holds_the_points_of_the_scan(tmp_path):
    n = 100
    folder = waveforms(tmp_path, n, photons=2e5, second=(2.5, 0.5))
    result = scan(ScanRequest(scan=folder, out=tmp_path / "out", las=True, device="cpu"))
    las = laspy.read(result.las_path)
    scales = json.loads(result.report_path.read_text())["found"]["las"]
    np.testing.assert_allclose(las.xyz, result.cloud.points, atol=0.5 * scales["scale_m"] + 1e-6)  # half a step, and float32 of the cloud
    np.testing.assert_allclose(las.intensity * scales["intensity_scale"], result.cloud.intensity, atol=scales["intensity_scale"])
    times, counts = np.unique(las.gps_time, return_counts=True)
    np.testing.assert_array_equal(times, np.linspace(0, 1, n))
    assert (counts == 2).all() and (las.number_of_returns == 2).all()
    near = np.linalg.norm(las.xyz[las.return_number == 1], axis=1)
    assert np.median(np.abs(np.sort(near) - np.linspace(2, 6, n))) < 0.02


def test_las_without_laspy_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(RequestError, match=r"pip install 'relit\[las\]'"):
        scan(ScanRequest(scan=write(tmp_path, ring()), out=tmp_path / "out", las=True, device="cpu"))
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_command_prints_where_everything_is(tmp_path):
    write(tmp_path, ring())
    command = [sys.executable, "-m", "service.cli.main", "scan", str(tmp_path), "--out", str(tmp_path / "o"), "--las",
               "--device", "cpu"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "points.ply" in done.stdout and "points.usdc" in done.stdout and "points.las" in done.stdout and "360 points" in done.stdout
    command[4] = str(tmp_path / "no")
    missing = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert missing.returncode == 2 and "holds no scan.json" in missing.stderr
