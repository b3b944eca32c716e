"""relit patterns: images and entries that a capture takes, the planner's table, and one sentence for what cannot be."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest

from service.depth.patterns.codes import CODES
from service.depth.patterns.projection import make_plan
from service.requests.patterns import PatternCode, PlanRequest
from stage.capture.manifest import Frame
from stage.patterns.codes import collect, draw
from tests.scenes.captures import files_in

SIZE = (96, 40)


def read(path) -> tuple[np.ndarray, str]:
    buffer = oiio.ImageBuf(str(path))
    return buffer.get_pixels(oiio.FLOAT), str(buffer.spec().format)


@pytest.mark.parametrize("code", list(PatternCode))
def test_images_are_what_their_entries_say(code, relit, tmp_path):
    relit.done("patterns", code, "--projector", "96x40", "--out", tmp_path / "out", "--axis", "both")
    frames = [Frame.model_validate(frame) for frame in json.loads((tmp_path / "out" / "patterns.json").read_text())["frames"]]
    found = collect([frame.pattern for frame in frames])
    assert {entry.axis for entry in found.codes} == {"column", "row"} and found.white is not None and found.black is not None
    assert len(frames) == len(list((tmp_path / "out").glob("*.png")))
    for frame in frames:
        pixels, _ = read(tmp_path / "out" / frame.image)
        expected = draw(frame.pattern, SIZE)
        np.testing.assert_allclose(pixels if expected.ndim == 3 else pixels[..., 0], expected, atol=0.5 / 255 + 1e-6)


def test_sixteen_bits_and_gamma(relit, tmp_path):
    assert relit("patterns", "ramp", "--projector", "96x40", "--out", tmp_path, "--bits", 16, "--gamma", 2.2).code == 0
    pixels, kind = read(tmp_path / "pattern_000.png")
    assert kind == "uint16"
    np.testing.assert_allclose(pixels[0, :, 0] ** 2.2, (np.arange(96) + 0.5) / 96, atol=2e-5)


def test_images_of_an_earlier_run_go_and_other_files_stay(relit, tmp_path):
    (tmp_path / "pattern_099.png").write_bytes(b"")  # before there is a patterns.json: of somebody else
    relit.done("patterns", "phase", "--projector", "96x40", "--out", tmp_path / "out")
    relit.done("patterns", "phase", "--projector", "96x40", "--out", tmp_path)
    (tmp_path / "out" / "note.png").write_bytes(b"")
    relit.done("patterns", "ramp", "--projector", "96x40", "--out", tmp_path / "out")
    images = [frame["image"] for frame in json.loads((tmp_path / "out" / "patterns.json").read_text())["frames"]]
    assert files_in(tmp_path / "out") == {*images, "patterns.json", "note.png"} and (tmp_path / "pattern_099.png").exists()


def test_plan_is_a_table(relit):
    outcome = relit.done("patterns", "--plan", "--projector", "640x480", "--fps", 30)
    point = next(line for line in outcome.out.splitlines() if line.startswith("point"))
    assert point.split()[1:4] == ["307200", "307200", "1.02e+04"]
    deep = relit("patterns", "--plan", "--projector", "640x480", "--baseline", 0.2, "--distance", 1, "--focal", 1000)
    assert len(next(line for line in deep.out.splitlines() if line.startswith("point")).split()) == 6


def test_every_code_has_a_row_and_the_planner_knows_its_cost():
    assert set(CODES) == set(PatternCode)
    rows = make_plan(PlanRequest(projector=(1280, 800), frame_rate=30, baseline=0.2, distance=1, focal=2000))
    assert [row.cost.name.split(",")[0] for row in rows] == ["point", "line", "binary or gray", "xor", "kary", "ramp", "phase", "micro",
                                                        "modulated"]
    by_name = {row.cost.name.split(",")[0]: row for row in rows}
    assert by_name["binary or gray"].cost.minimum == 11 and by_name["binary or gray"].cost.images == 24
    assert by_name["kary"].cost.minimum == 7
    assert by_name["phase"].cost.images == 12 and by_name["phase"].seconds == pytest.approx(0.4)
    assert all(row.cost.images >= row.cost.minimum and row.cost.column_sigma_px > 0 and row.depth_sigma_m > 0 for row in rows)
    assert make_plan(PlanRequest(projector=(1280, 800)))[0].depth_sigma_m is None


def test_plan_and_images_at_once(relit, tmp_path):
    outcome = relit("patterns", "gray", "--plan", "--projector", "96x40", "--steps", 5, "--out", tmp_path)
    assert outcome.code == 0 and "5 steps" in outcome.out and (tmp_path / "patterns.json").exists()


@pytest.mark.parametrize("options, words", [
    (["gray", "--projector", "96", "--out", "o"], "projector: is 96: give width x height"),
    (["gray", "--projector", "0x40", "--out", "o"], "projector"),
    (["gray", "--projector", "96x40"], "give a CODE and --out for the images, or --plan"),
    (["--projector", "96x40"], "give a CODE and --out"),
    (["--plan", "--projector", "96x40", "--out", "o"], "out is not used"),
    (["gray", "--projector", "96x40", "--out", "o", "--noise", "0.1"], "noise is not used: it is for --plan"),
    (["gray", "--projector", "96x40", "--out", "o", "--steps", "3"], "steps says nothing about gray"),
    (["phase", "--projector", "96x40", "--out", "o", "--periods", "16,16"], "not several different ones"),
    (["phase", "--projector", "96x40", "--out", "o", "--periods", "16,20"], "repeat after 80 px, the projector has 96"),
    (["gray-phase", "--projector", "96x40", "--out", "o", "--stripe", "9"], "stripes of 9 px number periods of 16 px less surely"),
    (["color", "--projector", "96x40", "--out", "o", "--base", "9"], "9 colours are not told apart"),
    (["xor", "--projector", "96x40", "--out", "o", "--base-bit", "9"], "base bit 9 does not exist in 7 bits"),
    (["--plan", "--projector", "96x40", "--noise", "0"], "noise"),
    (["--plan", "--projector", "96x40", "--baseline", "1"], "needs baseline, distance and focal together"),
    (["nonsense", "--projector", "96x40", "--out", "o"], "nonsense"),
])
def test_what_cannot_be_is_one_sentence(options, words, relit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert words in relit.refused("patterns", *options)
    assert list(tmp_path.iterdir()) == []
