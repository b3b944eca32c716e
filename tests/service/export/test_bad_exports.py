"""Exports that cannot be, or not as one expects: a sentence, and nothing half-written beside it."""

import dataclasses
import shutil

import numpy as np
import pytest
from pxr import Usd

from kernels.status import Status
from service.asset.usd.asset import write_asset
from service.asset.usd.inspect import inspect_usd
from stage.results.depth_maps import DepthMaps
from tests.scenes.captures import write_exr
from tests.scenes.surfaces import make_ball

every_suffix = pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])


def listing(folder):
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


def lonely(mask):
    """Two pixels of a mask that do not touch."""
    found = np.zeros_like(mask)
    found[12, 12] = found[4, 12] = True
    return found


BALL = make_ball()
MAPS = {
    "no height": ({"height": None}, "maps.exr: the maps have no height layer, so there is no surface to export"),
    "no pixel": ({"mask": np.zeros_like(BALL.mask)}, "maps.exr: the mask holds 0 pixels with a height"),
    "no neighbours": ({"mask": lonely(BALL.mask)}, "there is no face to export"),
    "no number": ({"height": np.full_like(BALL.height, np.nan)}, "layer height has 256 values that are not finite"),
    "foreign": (lambda path: write_exr(path, np.ones((4, 8, 3))), "maps.exr: carries no relit:camera attribute, so it is not a"),
    "half": (lambda path: path.write_bytes(path.read_bytes()[:path.stat().st_size // 2]), "maps.exr"),
    "text": (lambda path: path.write_text("no image"), "maps.exr"),
}


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
@pytest.mark.parametrize("maps", MAPS)
def test_maps_that_are_no_surface(relit, tmp_path, maps, suffix):
    change, words = MAPS[maps]
    dataclasses.replace(BALL, **(change if isinstance(change, dict) else {})).write(tmp_path / "maps.exr")
    if callable(change):
        change(tmp_path / "maps.exr")
    before = listing(tmp_path)
    relit("export", tmp_path, "--out", tmp_path / f"a{suffix}").refused(words)
    assert listing(tmp_path) == before


@pytest.mark.parametrize(("maps", "out", "words"), [
    ("none", "a.usdz", "none: is not there: run `relit solve` or `relit depth` first"),
    ("empty", "a.usdz", "empty/maps.exr: is not there: run `relit solve` or `relit"),
    ("maps.exr", "a.gltf", ".usda, .usdc or .usdz for USD, or .glb for glTF")])
def test_maps_that_are_not_there_and_an_asset_of_no_kind(relit, tmp_path, maps, out, words):
    (tmp_path / "empty").mkdir()
    BALL.write(tmp_path / "maps.exr")
    before = listing(tmp_path)
    relit("export", tmp_path / maps, "--out", tmp_path / out).refused(words)
    assert listing(tmp_path) == before


@every_suffix
@pytest.mark.parametrize("in_the_way", ["a folder with the asset's name", "a file in place of the textures",
                                        "a file in place of the folder"])
def test_what_is_in_the_way_stays(relit, tmp_path, suffix, in_the_way):
    make_ball(12).write(tmp_path / "maps.exr")
    target = tmp_path / "out" / f"a{suffix}"
    if in_the_way == "a folder with the asset's name":
        target.mkdir(parents=True)
        (target / "notes.txt").write_text("mine")
    elif in_the_way == "a file in place of the textures":
        target.parent.mkdir()
        (target.parent / "a_textures").write_text("mine")
    else:
        target.parent.write_text("mine")
    before = listing(tmp_path)
    outcome = relit("export", tmp_path, "--out", target)
    if suffix == ".usdz" and in_the_way == "a file in place of the textures":  # a package needs no folder
        assert outcome.code == 0 and {**before, f"out/a{suffix}": target.read_bytes()} == listing(tmp_path)
    else:
        outcome.refused(f"cannot write {target}: ")
        assert listing(tmp_path) == before


@every_suffix
def test_files_of_others_stay_in_the_folders(relit, tmp_path, suffix):
    make_ball(12).write(tmp_path / "maps.exr")
    out = tmp_path / "out"
    for name in ("notes.txt", "a_layers/shot.usda", "a_textures/painted.exr", "a_textures/wip/old.png", "b_textures/base_color.png"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("mine")
    before = listing(out)
    for _ in range(2):
        assert relit("export", tmp_path, "--out", out / f"a{suffix}").code == 0
        assert before.items() <= listing(out).items()
        assert not [p for p in out.iterdir() if p.name.startswith(".")]


def test_a_usda_and_a_usdc_share_their_folders(relit, tmp_path):
    make_ball(12).write(tmp_path / "maps.exr")
    assert relit("export", tmp_path, "--out", tmp_path / "out" / "a.usda").code == 0
    first = listing(tmp_path / "out")
    assert relit("export", tmp_path, "--out", tmp_path / "out" / "a.usdc").code == 0
    both = listing(tmp_path / "out")
    assert both.pop("a.usdc") and both == first
    for suffix in (".usda", ".usdc"):
        assert relit("inspect", tmp_path / "out" / f"a{suffix}").code == 0


@pytest.mark.parametrize("name", ["フクロウ", "2nd – try", "👩🏽‍🚀", "..", " ", "a\\b/c:d", "x" * 200])
def test_any_name_makes_an_asset(tmp_path, name):
    write_asset(make_ball(8), tmp_path / "here" / "a.usda", name=name)
    shutil.move(tmp_path / "here", tmp_path / "there")  # it may be moved with its folders
    asset = tmp_path / "there" / "a.usda"
    assert inspect_usd(asset).errors == ()
    usd_stage = Usd.Stage.Open(str(asset))
    root = usd_stage.GetDefaultPrim()
    assert (root.GetDisplayName() or root.GetName()) == name and Usd.ModelAPI(root).GetAssetName() == name
    assert root.GetName().isascii()


@pytest.mark.long
@pytest.mark.parametrize("stem", ["フクロウ 1", "a[1]", "a@b", "a#b%20", "{geo=mesh}"])
@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_any_file_name_makes_an_asset_that_finds_its_files(tmp_path, suffix, stem):
    write_asset(make_ball(8), tmp_path / f"{stem}{suffix}", name=stem)
    assert inspect_usd(tmp_path / f"{stem}{suffix}").errors == ()


def test_an_asset_that_is_grey_or_clipped_is_said_and_a_version_is_a_text(relit, tmp_path):
    dataclasses.replace(BALL, diffuse_albedo=None, specular=None, roughness=None).write(tmp_path / "maps.exr")
    said = "the maps have no diffuse_albedo, so the asset is grey: solve with a method that gives it"
    assert relit("export", tmp_path, "--out", tmp_path / "a.usdz").well().splitlines()[2:] == [f"warning  {said}"]
    dataclasses.replace(BALL, diffuse_albedo=np.full_like(BALL.diffuse_albedo, 1.5)).write(tmp_path / "maps.exr")
    assert f"{BALL.mask.sum()} pixels have a value outside 0…1" in relit("export", tmp_path, "--out", tmp_path / "a.usdz").well()
    relit("export", tmp_path, "--out", tmp_path / "b.usdz", "--version", "").refused("version")
    assert not (tmp_path / "b.usdz").exists()


def test_of_maps_and_a_depth_in_one_folder_the_asset_says_which_it_is_of(relit, tmp_path):
    BALL.write(tmp_path / "maps.exr")
    DepthMaps(camera=BALL.camera, mask=BALL.mask, depth=np.where(BALL.mask, 1, 0).astype(np.float32)).write(tmp_path / "depth.exr")
    assert f"{tmp_path}: holds a depth too" in relit("export", tmp_path, "--out", tmp_path / "a.usdz").well()
    for chosen in (tmp_path / "maps.exr", tmp_path / "depth.exr"):
        assert "holds a depth too" not in relit("export", chosen, "--out", tmp_path / "b.usdz").well()


@pytest.mark.parametrize(("ambiguous", "words"), [(1.0, "no normal is sure"), (0.5, "% of the solved normals are ambiguous"), (0.1, None)])
def test_normals_that_are_not_sure_are_said_again(relit, tmp_path, ambiguous, words):
    chosen = np.random.default_rng(0).permutation(BALL.mask.size).reshape(BALL.mask.shape) < ambiguous * BALL.mask.size
    status = np.where(BALL.mask, np.where(chosen, Status.AMBIGUOUS, Status.OK), Status.UNSOLVED).astype(np.uint8)
    dataclasses.replace(BALL, status=status).write(tmp_path / "maps.exr")
    out = relit("export", tmp_path, "--out", tmp_path / "a.usdz").out
    assert ("warning" in out) == (words is not None) and (words or "") in out
