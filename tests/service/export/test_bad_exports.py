"""Exports that cannot be, or not as one expects: a sentence, and nothing half-written beside it."""

import dataclasses
import shutil

import numpy as np
import pytest
from pxr import Usd

from service.asset.usd.asset import write_asset
from service.asset.usd.inspect import inspect_asset
from tests.scenes.captures import write_exr
from tests.scenes.surfaces import make_ball

SUFFIXES = (".usda", ".usdc", ".usdz")
every_suffix = pytest.mark.parametrize("suffix", SUFFIXES)


def listing(folder):
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


def lonely(ball):
    mask = np.zeros_like(ball.mask)
    mask[12, 12] = mask[4, 12] = True
    return dataclasses.replace(ball, mask=mask)


MAPS = {
    "no height": (lambda ball: dataclasses.replace(ball, height=None), "no height layer, so there is no surface to export"),
    "no pixel": (lambda ball: dataclasses.replace(ball, mask=np.zeros_like(ball.mask)), "there is no face to export"),
    "no neighbours": (lonely, "there is no face to export"),
    "no number": (lambda ball: dataclasses.replace(ball, height=np.full_like(ball.height, np.nan)),
                  "layer height has 256 values that are not finite"),
}


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
@pytest.mark.parametrize("maps", MAPS)
def test_maps_that_are_no_surface(relit, tmp_path, maps, suffix):
    change, words = MAPS[maps]
    change(make_ball()).write(tmp_path / "maps.exr")
    before = listing(tmp_path)
    outcome = relit("export", tmp_path, "--out", tmp_path / f"a{suffix}")
    assert (outcome.code, outcome.out) == (2, "") and words in outcome.err and outcome.err.count("\n") == 1
    assert listing(tmp_path) == before


def foreign(folder):
    write_exr(folder / "maps.exr", np.ones((4, 8, 3)))


def half(folder):
    make_ball().write(folder / "maps.exr")
    whole = (folder / "maps.exr").read_bytes()
    (folder / "maps.exr").write_bytes(whole[:len(whole) // 2])


def text(folder):
    (folder / "maps.exr").write_text("no image")


@pytest.mark.parametrize(("write", "words"), [(foreign, "maps.exr: carries no relit:camera attribute, so it is not a"),
                                              (half, "maps.exr"), (text, "maps.exr")])
def test_a_folder_that_is_not_ours(relit, tmp_path, write, words):
    (tmp_path / "solved").mkdir()
    write(tmp_path / "solved")
    before = listing(tmp_path)
    outcome = relit("export", tmp_path / "solved", "--out", tmp_path / "a.usda")
    assert (outcome.code, outcome.out) == (2, "") and words in outcome.err and outcome.err.count("\n") == 1
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
        assert (outcome.code, outcome.out) == (2, "") and f"cannot write {target}: " in outcome.err and outcome.err.count("\n") == 1
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
    write_asset(make_ball(8), tmp_path / "a.usda", name=name)
    assert inspect_asset(tmp_path / "a.usda").errors == ()
    usd_stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    root = usd_stage.GetDefaultPrim()
    assert (root.GetDisplayName() or root.GetName()) == name and Usd.ModelAPI(root).GetAssetName() == name
    assert root.GetName().isascii()


@pytest.mark.long
@pytest.mark.parametrize("stem", ["フクロウ 1", "a[1]", "a@b", "a#b%20", "{geo=mesh}"])
@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_any_file_name_makes_an_asset_that_finds_its_files(tmp_path, suffix, stem):
    write_asset(make_ball(8), tmp_path / f"{stem}{suffix}", name=stem)
    assert inspect_asset(tmp_path / f"{stem}{suffix}").errors == ()


def test_an_asset_may_be_moved_with_its_folders(tmp_path):
    write_asset(make_ball(8), tmp_path / "here" / "a.usda", name="a")
    shutil.move(tmp_path / "here", tmp_path / "there")
    assert inspect_asset(tmp_path / "there" / "a.usda").errors == ()


def test_without_albedo_the_asset_is_said_to_be_grey(relit, tmp_path):
    dataclasses.replace(make_ball(), diffuse_albedo=None, specular=None, roughness=None).write(tmp_path / "maps.exr")
    outcome = relit("export", tmp_path, "--out", tmp_path / "a.usdz")
    said = "the maps have no diffuse_albedo, so the asset is grey: solve with a method that gives it"
    assert outcome.code == 0 and outcome.out.splitlines()[2:] == [f"warning  {said}"]


def test_clipped_albedo_is_counted(relit, tmp_path):
    ball = make_ball()
    dataclasses.replace(ball, diffuse_albedo=np.full_like(ball.diffuse_albedo, 1.5)).write(tmp_path / "maps.exr")
    outcome = relit("export", tmp_path, "--out", tmp_path / "a.usdz")
    assert outcome.code == 0 and f"{ball.mask.sum()} pixels have a value outside 0…1" in outcome.out


def test_a_version_is_a_text(relit, tmp_path):
    make_ball(8).write(tmp_path / "maps.exr")
    outcome = relit("export", tmp_path, "--out", tmp_path / "a.usdz", "--version", "")
    assert outcome.code == 2 and "version" in outcome.err and not (tmp_path / "a.usdz").exists()
