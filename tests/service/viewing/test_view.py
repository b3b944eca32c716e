"""relit view as a command: what it writes of captures of every kind, what it refuses, and that files are whole."""

import json
import re
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

import service.viewing.view_files as viewing
from service.depth.depth import depth
from service.requests.captures import ViewRequest
from service.requests.depth import DepthRequest
from service.viewing import points
from service.viewing.view_files import view
from stage.formats.ply import read_ply
from stage.results.depth_maps import DepthMaps
from stage.results.maps import SurfaceMaps
from tests.marks import first_short
from tests.reference.view import View
from tests.scenes.captures import edit_frame, edit_manifest, files_in, make_scene, write_capture, write_exr, write_image, write_manifest
from tests.scenes.glossy import dome, write_dome, write_maps

ROOT = Path(__file__).parents[3]
FILES = {"view.json", "view.bin", "thumbnails.jpg", "card.jpg", "card_lights.jpg"}
TEXT = (ROOT / "docs" / "view.md").read_text(encoding="utf-8")
TABLES = {title: set(re.findall(r"`([a-z_0-9]+)`", " ".join(row.split("|")[1] for row in rows.splitlines())))
          for title, rows in re.findall(r"^\| (key[^|]*) \| \|\n\|---\|---\|\n((?:\|.*\n)+)", TEXT, re.MULTILINE)}
"""The keys in the first column of each table."""


def strict(text: str) -> dict:
    """JSON without NaN and infinity, which browsers refuse."""
    return json.loads(text, parse_constant=lambda word: pytest.fail(word))


def atlas(folder: Path) -> np.ndarray:
    return oiio.ImageBuf(str(folder / "thumbnails.jpg")).get_pixels(oiio.UINT8)


@pytest.mark.long
def test_the_owl(relit, tmp_path):
    out = relit("view", ROOT / "samples" / "owl", "--cache", tmp_path / "cache", "--out", tmp_path / "out").well()
    lines = dict(line.split(None, 1) for line in out.splitlines())
    assert lines["view"] == f"{tmp_path}/out/view.json" and lines["frames"] == "96"
    assert re.match(r"32 coefficient images: 0\.\d+ of 255 levels off", lines["relight"])
    assert files_in(tmp_path / "out") == FILES
    facts = strict((tmp_path / "out" / "view.json").read_text())
    assert (facts["schema"], facts["name"], facts["rows"], facts["cols"]) == ("relit.view/1", "owl", 320, 320)
    assert facts["layers"] == [] and facts["samples"] is None and facts["points"] is None and facts["findings"] == []
    assert facts["camera"]["pixel_size_m"] == 0.000675 and facts["provenance"]["relit:capture"] == "owl"
    frames = facts["frames"]
    assert [frame["image"] for frame in frames] == [f"{i:03d}.exr" for i in range(96)]
    manifest = json.loads((ROOT / "samples" / "owl" / "capture.json").read_text())
    assert frames[7]["direction"] == pytest.approx(manifest["frames"][7]["light"]["direction"], abs=1e-6)
    assert frames[7]["irradiance"] == [3, 3, 3] and frames[7]["kind"] == "light" and not frames[7]["near"]
    sheet = atlas(tmp_path / "out")
    places = np.array([frame["thumbnail"] for frame in frames])
    assert len(np.unique(places[:, :2], axis=0)) == 96 and (places[:, 2:] == 96).all()
    assert (places[:, 0] + 96 <= sheet.shape[1]).all() and (places[:, 1] + 96 <= sheet.shape[0]).all()
    assert 0.5 < sheet.shape[0] / sheet.shape[1] < 2  # near a square
    seen = [sheet[y : y + h, x : x + w].mean() for x, y, w, h in places]
    brightness = [np.mean(frame["mean"]) for frame in frames]
    assert np.corrcoef(np.argsort(np.argsort(seen)), np.argsort(np.argsort(brightness)))[0, 1] > 0.95  # one exposure for all
    assert (tmp_path / "out" / "view.json").stat().st_size < 1e6 and (tmp_path / "out" / "thumbnails.jpg").stat().st_size < 2e6


@pytest.mark.long
def test_the_card_shows_the_object_lit_from_where_the_grid_says(relit, tmp_path):
    assert relit("view", ROOT / "samples" / "lambert", "--cache", tmp_path / "cache", "--out", tmp_path).code == 0
    picture, sheet = (oiio.ImageBuf(str(tmp_path / name)).get_pixels(oiio.UINT8) for name in ("card.jpg", "card_lights.jpg"))
    assert picture.shape == (128, 128, 3) and sheet.shape == (800, 800, 3)
    assert np.abs(picture[:16, :16].astype(int) - 0x2B).max() <= 1  # blocks of the JPEG that hold the grey behind the object alone
    cells = sheet.reshape(5, 160, 5, 160, 3).swapaxes(1, 2).astype(float)
    for one, other in ((cells[2, 0], cells[2, 4]), (cells[0, 2].swapaxes(0, 1), cells[4, 2].swapaxes(0, 1))):  # left and right, up and down
        assert one[:, :80].mean() > 1.2 * other[:, :80].mean() and other[:, 80:].mean() > 1.2 * one[:, 80:].mean()


def test_patterns_have_frames_and_nothing_to_relight(relit, tmp_path):
    assert relit("view", ROOT / "samples" / "rig", "--out", tmp_path).code == 0
    assert (tmp_path / "card.jpg").stat().st_size > 1000 and not (tmp_path / "card_lights.jpg").exists()
    facts = strict((tmp_path / "view.json").read_text())
    assert facts["relight"] is None and {frame["kind"] for frame in facts["frames"]} == {"pattern"}
    assert facts["frames"][0]["label"] == "phase pattern, column, period 16.0, step 0, steps 4"
    assert facts["frames"][0]["direction"] is None and facts["frames"][0]["thumbnail"][2:] == [96, 72]
    assert not (ROOT / "samples" / "rig" / ".relit").exists()


@pytest.mark.parametrize("lights", [1, 4])
@first_short("mask", ["mask.png", None])
def test_few_lights_with_and_without_a_mask(relit, tmp_path, lights, mask):
    write_capture(tmp_path / "cap", make_scene(lights=lights), mask=mask)
    assert relit("view", tmp_path / "cap", "--out", tmp_path / "out").code == 0
    found = View(tmp_path / "out")
    assert len(found.facts["frames"]) == lights and (found.facts["relight"] is not None) == (lights == 4)
    if lights == 1:
        assert any("a normal needs three or more" in finding for finding in found.facts["findings"])
    else:
        matte = found.block(found.facts["relight"]["matte"], "u1", 16, 16)
        assert (matte == 255).all() == (mask is None)


@pytest.mark.long
def test_one_pixel(relit, tmp_path):
    write_capture(tmp_path / "cap", make_scene(size=1, lights=5))
    SurfaceMaps(camera=viewing.Capture.open(tmp_path / "cap").camera, mask=np.ones((1, 1), bool),
                normal=np.float32([[[0, 0, 1]]]), diffuse_albedo=np.full((1, 1, 3), 0.5), height=np.zeros((1, 1), np.float32)).write(
                    tmp_path / "maps.exr")
    outcome = relit("view", tmp_path / "cap", "--maps", tmp_path / "maps.exr", "--out", tmp_path / "out")
    assert outcome.code == 0 and "camera.resolution: is 1x1" in outcome.out
    found = View(tmp_path / "out")
    assert found.image("normal").reshape(-1).tolist() == [0, 0, 1] and found.facts["relight"]["terms"] >= 1
    assert found.samples("model").shape == (1, 1, 5, 3) and (found.samples("model") > 0).all()


def test_a_frame_or_a_mask_that_cannot_be_used_is_said_and_the_others_are_shown(relit, tmp_path):
    scene = make_scene()
    write_capture(tmp_path / "cap", scene)
    bad = scene.images[2].copy()
    bad[3, 4] = np.nan
    write_exr(tmp_path / "cap" / "002.exr", bad)
    out = relit("view", tmp_path / "cap", "--out", tmp_path / "out").well()
    warning, = (line for line in out.splitlines() if line.startswith("warning"))
    assert "002.exr: 1 pixel is not finite" in warning
    facts = strict((tmp_path / "out" / "view.json").read_text())
    assert facts["frames"][2]["thumbnail"] is None and facts["frames"][2]["mean"] is None and facts["frames"][2]["label"]
    assert all(facts["frames"][i]["thumbnail"] for i in (0, 1, 3, 4, 5)) and facts["relight"] is None
    write_capture(tmp_path / "cap", scene._replace(images=0 * scene.images))  # dark
    write_image(tmp_path / "cap" / "mask.png", np.zeros((16, 16), np.uint8))
    assert "the mask is empty" in relit("view", tmp_path / "cap", "--out", tmp_path / "out").well()
    facts = strict((tmp_path / "out" / "view.json").read_text())
    assert all(frame["thumbnail"] for frame in facts["frames"])
    assert facts["exposure"] == 1 and {frame["dark"] for frame in facts["frames"]} == {1}
    assert atlas(tmp_path / "out").max() <= 1


@pytest.mark.long
def test_ambient_light_is_shown_and_does_not_darken_the_exposure(tmp_path, relit):
    scene = make_scene(lights=4)
    write_capture(tmp_path / "cap", scene)
    relit("view", tmp_path / "cap", "--out", tmp_path / "plain")
    write_exr(tmp_path / "cap" / "off.exr", np.zeros((16, 16, 3)))
    edit_manifest(tmp_path / "cap", frames=lambda frames: [*frames, {"image": "off.exr", "light": {"type": "off"}}])
    relit("view", tmp_path / "cap", "--out", tmp_path / "out")
    plain, found = View(tmp_path / "plain").facts, View(tmp_path / "out").facts
    assert found["exposure"] == plain["exposure"] and found["frames"][4]["label"] == "off light" and found["frames"][4]["dark"] == 1
    white = np.percentile(scene.images.mean(axis=0)[scene.mask].max(axis=-1), 99)
    assert plain["exposure"] == pytest.approx(1 / white, rel=1e-5)


def test_time_of_flight_arrays_are_shown(relit, tmp_path):
    (tmp_path / "cap").mkdir()
    counts = np.random.default_rng(1).poisson(3.0, size=(6, 9, 20))
    np.save(tmp_path / "cap" / "a.npy", counts)
    write_manifest(tmp_path / "cap", {
        "schema": "relit.capture/1", "name": "flash", "camera": {"projection": "orthographic", "resolution": [9, 6]},
        "frames": [{"image": "a.npy", "tof": {"type": "pulsed", "bin_s": 1e-10, "start_s": 0.0}}]})
    assert relit("view", tmp_path / "cap", "--out", tmp_path / "out").code == 0
    frame, = View(tmp_path / "out").facts["frames"]
    assert frame["kind"] == "tof" and frame["label"].startswith("time of flight pulsed")
    assert frame["mean"] == pytest.approx([counts.sum(axis=2).mean()] * 3, rel=1e-6)


def test_near_lights_have_the_direction_that_the_object_sees(relit, tmp_path):
    write_capture(tmp_path / "cap", make_scene(lights=5))
    edit_manifest(tmp_path / "cap", camera={"projection": "orthographic", "resolution": [16, 16], "pixel_size_m": 0.01})
    edit_frame(tmp_path / "cap", 1, light={"type": "point", "position_m": [0.3, 0, 0.4], "intensity": [1, 2, 3]})
    assert relit("view", tmp_path / "cap", "--out", tmp_path / "out").code == 0
    frame = View(tmp_path / "out").facts["frames"][1]
    assert frame["near"] and frame["direction"] == pytest.approx([0.6, 0, 0.8]) and frame["irradiance"] == pytest.approx([4, 8, 12])
    assert frame["label"] == "near light at 0.3, 0, 0.4 m" and View(tmp_path / "out").facts["relight"] is not None


@pytest.mark.parametrize(("words", "sentence"), [
    (["none", "--out", "out"], "none: there is no such folder"),
    (["cap", "--maps", "none", "--out", "out"], "none: is not there: run `relit solve` or `relit depth` first"),
    (["cap", "--maps", "cap", "--out", "out"], "cap: holds neither maps.exr nor depth.exr"),
    (["cap", "--maps", "cap/000.exr", "--out", "out"], "000.exr: carries no relit:camera attribute"),
    (["cap", "--maps", "large", "--out", "out"], "maps.exr: is 24x24, the capture 16x16: these are not its"),
    (["cap", "--maps", "spoilt", "--out", "out"], "maps.exr: layer roughness has 1 values that are not finite"),
    (["cap", "--maps", "codes", "--out", "out"], "maps.exr: layer status holds codes that this version does"),
    (["cap", "--terms", "0", "--out", "out"], "terms"),
    (["cap", "--out", "file/out"], "cannot write"),
])
def test_what_is_refused(relit, tmp_path, words, sentence):
    write_capture(tmp_path / "cap", make_scene())
    (tmp_path / "file").write_text("")
    write_maps(tmp_path / "large", dome())
    camera, inside = viewing.Capture.open(tmp_path / "cap").camera, np.ones((16, 16), bool)
    spoilt = np.where(np.arange(256).reshape(16, 16) == 77, np.inf, 0.5)
    SurfaceMaps(camera=camera, mask=inside, roughness=spoilt).write(tmp_path / "spoilt" / "maps.exr")
    SurfaceMaps(camera=camera, mask=inside, status=np.full((16, 16), 77, np.uint8)).write(tmp_path / "codes" / "maps.exr")
    words = [str(tmp_path / word) if not word.startswith("-") and not word.isdigit() else word for word in words]
    relit("view", *words).refused(sentence)
    assert files_in(tmp_path / "out") == set()


@pytest.mark.long
def test_a_run_again_replaces_and_an_interrupted_one_leaves_no_view(tmp_path, monkeypatch):
    """view.json is written last and taken away first: it never describes other blocks."""
    write_dome(tmp_path / "cap", dome(), lights=8)
    request = ViewRequest(capture=tmp_path / "cap", out=tmp_path / "out", device="cpu")
    viewing.view(request)
    first = (tmp_path / "out" / "view.json").read_bytes()
    viewing.view(request.model_copy(update={"terms": 2}))
    second = (tmp_path / "out" / "view.json").read_bytes()
    assert first != second

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    def interrupted(part: str) -> None:
        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(viewing, part, interrupt)
            viewing.view(request)

    interrupted("write_relighting")
    assert (tmp_path / "out" / "view.json").read_bytes() == second and files_in(tmp_path / "out") == FILES  # nothing was replaced yet
    interrupted("write_thumbnails")
    assert files_in(tmp_path / "out") == FILES - {"view.json"}
    viewing.view(request)
    assert (tmp_path / "out" / "view.json").read_bytes() == first


def test_the_results_never_replace_an_input(relit, tmp_path):
    write_capture(tmp_path / "cap", make_scene())
    frame = tmp_path / "cap" / "thumbnails.jpg"
    write_image(frame, np.full((16, 16, 3), 128, np.uint8))
    edit_frame(tmp_path / "cap", 1, image="thumbnails.jpg")
    before = frame.read_bytes()
    relit("view", tmp_path / "cap", "--out", tmp_path / "cap").refused("thumbnails.jpg is an input: choose another folder")
    assert frame.read_bytes() == before and not (tmp_path / "cap" / "view.bin").exists()


RIG = Path(__file__).parents[3] / "samples" / "rig"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("points")
    depth(DepthRequest(capture=RIG, out=folder / "maps", cache=folder / "cache", device="cpu"))
    return folder


def show(folder, maps="maps") -> View:
    view(ViewRequest(capture=RIG, maps=folder / maps, out=folder / "out", cache=folder / "cache", device="cpu"))
    return View(folder / "out")


def arrays(found: View) -> tuple[np.ndarray, ...]:
    facts = found.facts["points"]
    count = facts["count"] + facts["unsure"]
    return (found.block(facts["positions"], "f4", count, 3), found.block(facts["colours"], "u1", count, 3),
            found.block(facts["depth"], "f4", count), found.block(facts["confidence"], "u1", count))


def test_points_are_those_of_the_cloud_and_then_the_unsure_ones(folder):
    found = show(folder)
    facts, cloud = found.facts["points"], read_ply(folder / "maps" / "points.ply")
    maps = DepthMaps.read(folder / "maps" / "depth.exr", unsure=True)
    positions, colours, depths, confidence = arrays(found)
    assert (facts["count"], facts["step"]) == (len(cloud.points), 1)
    np.testing.assert_allclose(positions[: facts["count"]], cloud.points, rtol=1e-6, atol=1e-7)
    assert np.array_equal(colours[: facts["count"]], cloud.colours)
    assert np.array_equal(depths[: facts["count"]], maps.depth[maps.mask])
    assert np.array_equal(confidence[: facts["count"]], np.rint(255 * maps.confidence[maps.mask]).astype(np.uint8))
    unsure = maps.estimated & ~maps.mask
    assert facts["unsure"] == unsure.sum() > 0
    assert np.array_equal(depths[facts["count"] :], maps.depth[unsure])
    assert found.facts["relight"] is None and found.facts["samples"] is None
    assert found.facts["layers"][0]["name"] == "depth"


@pytest.mark.long
def test_every_second_pixel_of_a_large_depth_and_grey_without_the_cloud(folder, monkeypatch):
    monkeypatch.setattr(points, "MOST_POINTS", 15000)
    found = show(folder)
    maps = DepthMaps.read(folder / "maps" / "depth.exr")
    assert found.facts["points"]["step"] == 2 and found.facts["points"]["count"] <= 15000
    assert np.array_equal(arrays(found)[2][: found.facts["points"]["count"]], maps.depth[::2, ::2][maps.mask[::2, ::2]])
    (folder / "alone").mkdir()
    (folder / "alone" / "depth.exr").write_bytes((folder / "maps" / "depth.exr").read_bytes())
    colours = arrays(show(folder, "alone"))[1]
    assert (colours == colours[:, :1]).all() and np.ptp(colours) > 100


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> list[dict]:
    folder = tmp_path_factory.mktemp("docs")
    surface, rig = dome(), ROOT / "samples" / "rig"
    write_dome(folder / "cap", surface, lights=8)
    write_maps(folder / "maps", surface, regime=surface.mask + 0.0)
    depth(DepthRequest(capture=rig, out=folder / "depth", device="cpu"))
    view(ViewRequest(capture=folder / "cap", maps=folder / "maps", out=folder / "a", device="cpu"))
    view(ViewRequest(capture=rig, maps=folder / "depth", out=folder / "b", device="cpu"))
    return [View(folder / name).facts for name in "ab"]


@pytest.mark.long
@pytest.mark.parametrize(("title", "of"), [
    ("key", lambda facts: [facts]), ("key of `layers[]`", lambda facts: facts["layers"]),
    ("key of `frames[]`", lambda facts: facts["frames"]), ("key of `relight`", lambda facts: [facts["relight"]]),
    ("key of `samples`", lambda facts: [facts["samples"]]), ("key of `points`", lambda facts: [facts["points"]]),
], ids=lambda value: value if isinstance(value, str) else "")
def test_the_tables_have_the_keys_of_the_files(written, title, of):
    keys = {key for facts in written for each in of(facts) if each is not None for key in each}
    assert keys and TABLES[title] == keys


@pytest.mark.long
def test_the_sizes_of_the_format_are_those_of_the_code(written):
    facts = written[0]
    assert facts["relight"]["directions"] == [64, 32] and facts["layers"][0]["levels"][0]["tile"] == 256
    assert {code["name"] for code in facts["samples"]["codes"].values()} == {"saturated", "shadowed", "backlit"}


@pytest.mark.long
def test_a_capture_under_lights_that_nobody_has_measured_is_relit_under_those_that_a_solve_found(relit, tmp_path):
    """Placeholders all point at the camera: a picture that was relit with them would be another than it says."""
    sample, folder = ROOT / "samples" / "lambert", tmp_path / "unmeasured"
    folder.mkdir()
    manifest = json.loads((sample / "capture.json").read_text())
    for frame in manifest["frames"]:
        frame["light"] = {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}
    for file in sample.glob("[!.]*"):
        (folder / file.name).write_bytes(file.read_bytes())
    (folder / "capture.json").write_text(json.dumps(manifest))
    relit("view", folder, "--out", tmp_path / "alone").well()
    relit("solve", folder, "--lights", "unknown", "--method", "lambert", "--out", tmp_path / "maps")  # all are unsure
    relit("view", folder, "--maps", tmp_path / "maps", "--out", tmp_path / "solved").well()
    alone, solved = (strict((tmp_path / name / "view.json").read_text()) for name in ("alone", "solved"))
    assert alone["relight"] is None and {frame["direction"] for frame in alone["frames"]} == {None}
    assert viewing.UNMEASURED in alone["findings"] and viewing.UNMEASURED not in solved["findings"]
    found = strict((tmp_path / "maps" / "report.json").read_text())["found"]["unknown_lights"]["directions"]
    assert np.allclose([frame["direction"] for frame in solved["frames"]], found, atol=1e-5)  # the report has five digits
    assert solved["relight"]["terms"] > 3 and solved["samples"] is not None
    edit_manifest(folder, frames=lambda frames: frames[:-1])
    fewer = relit("view", folder, "--maps", tmp_path / "maps", "--out", tmp_path / "fewer")
    fewer.refused("the maps come from a solve that has found the lights of")
