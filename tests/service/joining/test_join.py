"""The files of `relit join`."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from kernels.status import Status
from service.light_estimation.lambertian import degrees_between
from stage.capture.camera import Camera
from stage.results.depth_maps import CALIBRATION_SIGMA, DepthMaps
from stage.results.maps import SurfaceMaps
from tests.marks import first_short
from tests.scenes.joined import MM, drifting, see

SIGMA, NOISE, SIZE = 0.4 * MM, 0.5, 96


def write(folder: Path, *, perspective: bool = True, shape: str = "wave", mirrored: bool = False, camera: dict | None = None,
          depth_camera: dict | None = None, drop: tuple[str, ...] = ()) -> tuple[Path, Path, np.ndarray, np.ndarray]:
    """Results of both commands for one view; and its true z and normals."""
    view = see(shape, size=SIZE, perspective=perspective)
    given = {"projection": "perspective", "focal_px": (500.0, 500.0)} if perspective else {"projection": "orthographic", "pixel_size_m": MM}
    given |= {"resolution": (SIZE, SIZE)}
    inside = np.ones(view.z.shape, dtype=bool)
    inside[:3] = False
    normal = drifting(view.normal, noise=NOISE, drift=2)
    normal = normal * np.array([-1, 1, 1])[:, None, None] if mirrored else normal
    status = np.where(inside, Status.OK, Status.DARK).astype(np.uint8)
    layers = {"normal": np.moveaxis(normal, 0, -1).astype(np.float32), "sigma": np.full(view.z.shape, NOISE, dtype=np.float32),
              "diffuse_albedo": np.full((*view.z.shape, 3), 0.5), "height": np.zeros(view.z.shape, dtype=np.float32)}
    maps = SurfaceMaps(camera=Camera(**{**given, **(camera or {})}), mask=inside, status=status, provenance={"relit:capture": "wave"},
                       **{name: layer for name, layer in layers.items() if name not in drop})
    depth = -view.z + SIGMA * np.random.default_rng(2).standard_normal(view.z.shape)
    measured = np.random.default_rng(3).random(view.z.shape) > 0.1
    depths = DepthMaps(camera=Camera(**{**given, **(depth_camera or {})}), mask=measured, depth=depth.astype(np.float32),
                       sigma=None if "depth sigma" in drop else np.full(view.z.shape, SIGMA, dtype=np.float32))
    for name in ("solved", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    maps.write(folder / "solved" / "maps.exr")
    depths.write(folder / "depth" / "depth.exr")
    return folder / "solved", folder / "depth", view.z, view.normal


@first_short("perspective", [True, False])
def test_the_joined_surface_is_better_than_both(relit, tmp_path, perspective):
    solved, depth, z, normal = write(tmp_path, perspective=perspective)
    outcome = relit.done("join", solved, depth, "--out", tmp_path / "joined")
    assert "mm, of the depth alone 0.4 mm" in outcome.out
    found = SurfaceMaps.read(tmp_path / "joined" / "maps.exr")
    assert found.height is not None and found.height_sigma is not None and found.normal is not None and found.status is not None
    assert found.mask[3:].mean() > 0.99 and not found.mask[:3].any()
    error = (found.height - z)[found.mask]
    assert np.sqrt((error**2).mean()) < SIGMA / 2
    given = SurfaceMaps.read(solved / "maps.exr").normal
    before = degrees_between(np.moveaxis(given, -1, 0), normal)[found.mask].mean()
    assert degrees_between(np.moveaxis(found.normal, -1, 0), normal)[found.mask].mean() < before
    assert (np.abs(error) <= 3 * found.height_sigma[found.mask]).mean() > 0.95
    assert found.camera.surface_z_m == pytest.approx(z[found.mask].mean(), abs=SIGMA)
    assert set(np.unique(found.status)) <= {int(Status.OK), int(Status.DARK), int(Status.UNSURE)}
    report = json.loads((tmp_path / "joined" / "report.json").read_text())
    assert report["pixels"]["solved"] == found.mask.sum() and report["sigma_m"]["depth_median"] == pytest.approx(SIGMA, rel=1e-3)
    assert report["relief_unexplained"] < 0.1


@pytest.mark.long
def test_what_the_calibration_leaves_open_is_said_again(relit, tmp_path):
    """A depth whose scale is known to 2 % was joined to hundredths of a millimetre without a word."""
    solved, depth, z, _ = write(tmp_path)
    for shared, said in ((0.02 * abs(float(np.median(z))), True), (1e-6, False)):
        replace(DepthMaps.read(depth / "depth.exr"), provenance={CALIBRATION_SIGMA: f"{shared:g}"}).write(depth / "depth.exr")
        relit.done("join", solved, depth, "--out", tmp_path / "joined")
        report = json.loads((tmp_path / "joined" / "report.json").read_text())
        assert report["calibration_sigma_m"] == pytest.approx(shared, rel=1e-5)
        assert any(each.startswith(f"depth: its calibration leaves {shared:.3g} m open") for each in report["warnings"]) == said


def test_an_asset_is_made_of_it(relit, tmp_path):
    solved, depth, z, _ = write(tmp_path)
    assert relit("join", solved / "maps.exr", depth / "depth.exr", "--out", tmp_path / "joined").code == 0
    relit.done("export", tmp_path / "joined", "--out", tmp_path / "wave.usda")
    stage = Usd.Stage.Open(str(tmp_path / "wave.usda"))
    points = next(np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get()) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    assert np.ptp(points[:, 2]) == pytest.approx(np.ptp(z[3:]), rel=0.1)


@pytest.mark.long
def test_steps_of_a_rounded_depth_are_said(relit, tmp_path):
    solved, depth, *_ = write(tmp_path)
    given = DepthMaps.read(depth / "depth.exr")
    replace(given, depth=(np.round(given.depth / (5 * SIGMA)) * 5 * SIGMA).astype(np.float32)).write(depth / "depth.exr")
    relit.done("join", solved, depth, "--out", tmp_path / "joined")
    report = json.loads((tmp_path / "joined" / "report.json").read_text())
    assert any(each.startswith("depth: its values lie in steps of 0.002 m") for each in report["warnings"])


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"mirrored": True}, "of the relief in .* unexplained: they are not of one"),
    ({"depth_camera": {"focal_px": (510.0, 510.0)}}, r"depth\.exr: focal_px of its camera is not that of"),
    ({"depth_camera": {"principal_px": (40.0, 48.0)}}, "principal_px of its camera is not that of"),
    ({"perspective": False, "camera": {"pixel_size_m": None}, "depth_camera": {"pixel_size_m": None}}, "has no pixel_size_m"),
    ({"drop": ("sigma",)}, r"maps\.exr: has no layer sigma"),
    ({"drop": ("normal",)}, r"maps\.exr: has no layer normal"),
    ({"drop": ("depth sigma",)}, r"depth\.exr: has no layer sigma"),
])
def test_what_is_not_of_one_view_is_refused(relit, tmp_path, changes, sentence):
    solved, depth, *_ = write(tmp_path, **changes)
    assert re.search(sentence, relit.refused("join", solved, depth, "--out", tmp_path / "joined"))
    assert not (tmp_path / "joined").exists() or not list((tmp_path / "joined").iterdir())


def test_another_place_of_the_camera_is_refused(relit, tmp_path):
    pose = np.eye(4)
    moved = pose.copy()
    moved[0, 3] = 0.1
    solved, depth, *_ = write(tmp_path, camera={"world_from_camera": pose.tolist()}, depth_camera={"world_from_camera": moved.tolist()})
    relit("join", solved, depth, "--out", tmp_path / "joined").refused("world_from_camera of its camera is not that of")


def test_inputs_are_not_replaced_and_must_be_there(relit, tmp_path):
    solved, depth, *_ = write(tmp_path)
    before = (solved / "maps.exr").read_bytes()
    assert "would replace" in relit.refused("join", solved, depth, "--out", solved)
    assert (solved / "maps.exr").read_bytes() == before
    assert "run `relit depth` first" in relit.refused("join", solved, tmp_path / "nothing", "--out", tmp_path / "joined")


def test_a_lens_without_distortion_and_rounded_zeros_are_the_same_camera(relit, tmp_path):
    pose = np.eye(4)
    pose[0, 1] = 1e-17
    solved, depth, *_ = write(tmp_path, camera={"world_from_camera": np.eye(4).tolist()}, depth_camera={
        "world_from_camera": pose.tolist(), "distortion": {"model": "brown_conrady"}})
    assert relit("join", solved, depth, "--out", tmp_path / "joined").code == 0
