"""relit relight of a folder of captures: one a time step, one frame each."""

import json

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.formats import exr
from tests.scenes.captures import edit_manifest, files_in, make_scene, write_capture, write_exr

SCENE = make_scene(size=8, lights=5)


@pytest.fixture
def sequence(tmp_path):
    """Three time steps: the subject gets brighter, and the second has mirrored lights."""
    for step, level in (("t02", 2.0), ("t10", 3.0), ("t01", 1.0)):
        write_capture(tmp_path / "seq" / step, SCENE._replace(images=SCENE.images * level), name=step)
    turned = [{"image": f"{i:03d}.exr", "light": {"type": "distant", "direction": [-x, y, z], "irradiance": irradiance}}
              for i, ((x, y, z), irradiance) in enumerate(zip(SCENE.directions.tolist(), SCENE.irradiance.tolist(), strict=True))]
    edit_manifest(tmp_path / "seq" / "t02", frames=turned)
    (tmp_path / "seq" / "notes").mkdir()
    write_exr(tmp_path / "sky.exr", np.random.default_rng(3).random((8, 16, 3)))
    return tmp_path / "seq"


def pixels(path):
    channels, metadata = exr.read(path)
    return np.stack([channels[name] for name in "RGB"], axis=-1), metadata


def test_each_capture_gives_the_frame_that_it_gives_alone(relit, sequence, tmp_path):
    before = files_in(sequence)
    outcome = relit.done("relight", sequence, "--environment", tmp_path / "sky.exr", "--out", tmp_path / "f" / "a.##.exr")
    assert outcome.out.startswith(f"frames   {tmp_path}/f/a.01.exr … a.03.exr\ncaptures 3, one a frame\n")
    assert {name.split("/")[0] + "/.relit" for name in files_in(sequence) - before} == {"t01/.relit", "t02/.relit", "t10/.relit"}
    for number, step in enumerate(("t01", "t02", "t10"), start=1):
        relit.done("relight", sequence / step, "--environment", tmp_path / "sky.exr", "--out", tmp_path / "one" / f"{step}.#.exr")
        theirs, metadata = pixels(tmp_path / "f" / f"a.{number:02d}.exr")
        assert np.array_equal(theirs, pixels(tmp_path / "one" / f"{step}.1.exr")[0])
        assert metadata["relit:capture"] == step and metadata["relit:frame"] == str(number)


def test_frames_are_lit_by_the_schedule(relit, sequence, tmp_path):
    relit.done("relight", sequence, "--environment", tmp_path / "sky.exr", "--out", tmp_path / "f" / "a.##.exr",
               "--frames", "11-13", "--spin-degrees", "90", "--cache", tmp_path / "cache")
    assert {name.split("/")[0] for name in files_in(tmp_path / "cache")} == {"t01", "t02", "t10"}
    assert not (sequence / "t01" / ".relit").exists()
    assert [pixels(tmp_path / "f" / f"a.{n}.exr")[1]["relit:turn_degrees"] for n in (11, 12, 13)] == ["0", "30", "60"]
    again = relit("relight", sequence, "--environment", tmp_path / "sky.exr", "--out", tmp_path / "f" / "a.##.exr",
                  "--frames", "11-13", "--spin-degrees", "90", "--cache", tmp_path / "cache")
    assert "skipped  3 of 3 frames" in again.out


def test_one_capture_is_open_at_a_time(relit, sequence, tmp_path, monkeypatch):
    """When a capture is opened, the frame before the last has been written: nothing piles up."""
    written = []

    def opened(path, *choices):
        written.append(len(files_in(tmp_path / "f")))
        return open_capture(path, *choices)

    open_capture = Capture.open
    monkeypatch.setattr("service.relight.opened_capture.Capture.open", opened)
    assert relit("relight", sequence, "--environment", tmp_path / "sky.exr", "--out", tmp_path / "f" / "a.##.exr").code == 0
    assert written[0] == 0 and len(written) == 3 and written[2] >= 1


@pytest.mark.long
def test_layers_come_from_a_folder_of_maps_a_capture(relit, sequence, tmp_path):
    for step in ("t01", "t02", "t10"):
        assert relit("solve", sequence / step, "--method", "lambert", "--out", tmp_path / "maps" / step).code == 0
    arguments = ["relight", sequence, "--environment", tmp_path / "sky.exr", "--out", tmp_path / "f" / "a.##.exr", "--aov", "normal",
                 "--maps", tmp_path / "maps"]
    assert relit(*arguments).code == 0
    first, second = (exr.read(tmp_path / "f" / f"a.0{n}.exr")[0]["normal.X"].astype(float) for n in (1, 2))
    assert np.allclose(first, -second, atol=2e-3) and np.abs(first).max() > 0.5  # its lights are mirrored, and so are its normals
    (tmp_path / "maps" / "t10" / "maps.exr").unlink()
    assert "maps/t10/maps.exr: is not there: run `relit solve` first" in relit.refused(*arguments, "--overwrite")


@pytest.mark.parametrize(("spoil", "options", "words"), [
    (lambda seq: None, ["--frames", "1-4"],
     "--frames 1-4: asks for 4 frames, the sequence has 3"),
    (lambda seq: write_capture(seq / "t10", make_scene(size=4, lights=5)), [],
     "t10: is 4x4, t01 8x8: the captures of a sequence share one"),
    (lambda seq: edit_manifest(seq / "t10", color_space="lin_ap1_scene"), [],
     "t10: is lin_ap1_scene, t01 lin_rec709_scene: the captures of"),
    (lambda seq: edit_manifest(seq / "t10", colour="red"), [], "t10/capture.json: colour: is not a known key"),
    (lambda seq: None, ["--out", "seq/t10/00#.exr"], "seq/t10/001.exr is an input"),
    (lambda seq: [path.unlink() for path in seq.glob("*/capture.json")], [], "seq: holds no capture.json"),
], ids=["count", "resolution", "colour space", "manifest", "over an input", "no captures"])
def test_bad_sequences(relit, sequence, tmp_path, monkeypatch, spoil, options, words):
    monkeypatch.chdir(tmp_path)
    spoil(sequence)
    before = files_in(tmp_path)
    outcome = relit("relight", "seq", "--environment", "sky.exr", *(options if "--out" in options else ["--out", "f/a.##.exr", *options]))
    assert outcome.code == 2 and words in outcome.err and outcome.err.count("\n") == 1, outcome.err
    assert files_in(tmp_path) == before


def test_a_bad_image_late_in_the_sequence_leaves_the_frames_before_it(relit, sequence, tmp_path):
    write_exr(sequence / "t10" / "002.exr", np.full((8, 8, 3), np.nan))
    arguments = ["relight", sequence, "--environment", tmp_path / "sky.exr", "--out", tmp_path / "f" / "a.##.exr"]
    assert "t10/002.exr: 64 pixels are not finite" in relit.refused(*arguments)
    assert files_in(tmp_path / "f") <= {"a.01.exr", "a.02.exr"}
    write_exr(sequence / "t10" / "002.exr", SCENE.images[2])
    assert relit(*arguments, "--report", tmp_path / "r.json").code == 0
    assert files_in(tmp_path / "f") == {"a.01.exr", "a.02.exr", "a.03.exr"}
    report = json.loads((tmp_path / "r.json").read_text())
    assert [one["name"] for one in report["inputs"]["captures"]] == ["t01", "t02", "t10"]
