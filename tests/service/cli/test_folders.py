"""What a folder is told to hold that was given where something else is expected."""

from pathlib import Path

import pytest

from service.boards.height_files import BOARD_FILE
from service.comparison.compare import DEVIATIONS_FILE
from service.depth.scan import USD_FILE
from service.depth.separate import SEPARATION_FILE
from service.scans.fusion.fuse import MESH_FILE
from stage.capture import manifest
from stage.capture.sequence import SEQUENCE_FILE
from stage.folders import KNOWN
from stage.results.depth_maps import DEPTH_FILE
from stage.results.maps import MAPS_FILE
from stage.sets.board import SCAN_FILE
from stage.sets.scan_set import SCAN_SET_FILE
from stage.tof import scan

RIG = Path(__file__).parents[3] / "samples" / "rig"
TRIANGLE = "solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n"
LIGHT = ("--light", "0.1,0.2,0.4,0.05,0.05,0.05")


def test_the_names_are_those_that_commands_write():
    """`site.usda` is written by the tiles of fuse, whose name is tested there."""
    written = {BOARD_FILE, DEVIATIONS_FILE, USD_FILE, SEPARATION_FILE, MESH_FILE, manifest.FILE_NAME, SEQUENCE_FILE, DEPTH_FILE, MAPS_FILE,
               SCAN_FILE, SCAN_SET_FILE, scan.FILE_NAME}
    assert {*KNOWN} - {"site.usda"} == written


@pytest.mark.parametrize(("held", "arguments", "words"), [
    ("mesh.ply", ("export", "{}", "--out", "a.usdz"), "maps.exr: is not there: it holds mesh.ply, a surface of several scans, a "
                                                      "result of `relit fuse`, which `relit compare` takes"),
    ("scan-set.json", ("export", "{}", "--out", "a.usdz"), "it holds scan-set.json, a scan set, which `relit register` and"),
    ("depth.exr", ("shade", "{}", *LIGHT, "--out", "a.exr"), "it holds depth.exr, a depth, a result of `relit depth`, which"),
    ("depth.exr", ("solve", "{}", "--out", "o"), "d: holds no capture.json: it holds depth.exr, a depth"),
    ("capture.json", ("fuse", "{}", "--out", "o"), "d: holds no scan-set.json: it holds capture.json, a capture"),
    ("capture.json", ("scan", "{}", "--out", "o"), "d: holds no scan.json: it holds capture.json, a capture"),
    ("scan.json", ("depth", "{}", "--out", "o"), "the shots of a scanning laser, which `relit scan` measures"),
    ("depth.exr", ("compare", "{}", "--design", "{}/part.stl", "--out", "o"), "d/mesh.ply: is not there: it holds depth.exr, a depth"),
    ("notes.txt", ("solve", "{}", "--out", "o"), "d: holds no capture.json: see `relit import`"),
    ("capture.json", ("export", "{}", "--out", "a.usdz"), "d/maps.exr: is not there: run `relit solve` or `relit depth` first")])
def test_folders_of_another_kind_are_named(relit, tmp_path, held, arguments, words):
    folder = tmp_path / "d"
    folder.mkdir()
    (folder / held).touch()
    (folder / "part.stl").write_text(TRIANGLE)
    relit(*(part.format(folder) for part in arguments)).refused(words)


def test_a_sequence_is_named_with_a_step(relit, tmp_path):
    (tmp_path / "seq" / "s2").mkdir(parents=True)
    (tmp_path / "seq" / "s2" / manifest.FILE_NAME).touch()
    assert f"such as {tmp_path}/seq/s2" in relit.refused("info", tmp_path / "seq")


@pytest.mark.parametrize("arguments", [("solve",), ("solve", "--method", "gradient"), ("solve", "--lights", "unknown")])
def test_patterns_are_for_another_command(relit, tmp_path, arguments):
    command, *options = arguments
    relit(command, RIG, *options, "--out", tmp_path / "o").refused("frames with pattern are for relit depth")
