"""Solder paste on the pads of a Gerber layer: what was printed comes back in per cent, and limits decide with their σ."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from service.boards.board_capability import capability
from service.boards.datum import find_mark, fit_datum, lay
from service.boards.paste import measure_paste
from service.boards.shared_print import shared_sentences
from service.boards.stitching.grid import BoardGrid, HeightMap
from stage.errors import BoardError
from stage.formats.gerber import read_pads
from tests.scenes.board import write_depth
from tests.scenes.paste_layer import write_drill, write_layer
from tests.scenes.printed_board import PADS, PASTE, PIXEL, SIGMA, THICK, Print, measured, surface, write_board

WIDE = {"volume_percent": [85, 115], "height_percent": [75, 125], "area_percent": [85, 115], "offset_percent": 8}
HOLES = [(0.0, 8.2e-4), (-8.4e-4, -4.1e-4), (8.4e-4, -4.1e-4)]
BORE = 2.5e-4


def limits(path: Path, **classes: dict) -> Path:
    path.write_text(json.dumps({"schema": "relit.paste-limits/1", "classes": [
        {"name": name, "limits": [rule] if isinstance(rule, dict) else rule} for name, rule in classes.items()]}))
    return path


def printed(folder: Path, height: np.ndarray, seed: int) -> Path:
    return write_board(folder, measured(height, np.random.default_rng(seed)))


def inspect(relit, board: Path, *arguments):
    """The outcome, the pads of the table by name, and the report."""
    out = board / "out"
    outcome = relit("inspect-paste", board, "--stencil-m", THICK, "--out", out, "--device", "cpu", *arguments)
    if not (out / "report.json").exists():
        return outcome, {}, {}
    with open(out / "pads.csv", newline="") as table:
        return outcome, {row["name"]: row for row in csv.DictReader(table)}, json.loads((out / "report.json").read_text())


def test_faults_of_a_print_are_told_with_their_size(relit, tmp_path):
    """Paste as wide as its opening holds its thickness times its area; 18 µm of copper pass by pads 4 to 7 and count on their flanks."""
    what = Print(missing=(9,), shift=(2, 4e-5), volume=(3, 0.8), bridge=(4, 5), warp=4e-6)
    layer = write_layer(tmp_path / "paste.gbr", names=[f"U1,{number}" for number in range(12)])
    outcome, pads, report = inspect(relit, printed(tmp_path / "b", surface(what), 1), "--paste", layer,
                                    "--limits", limits(tmp_path / "limits.json", fine=WIDE))
    assert outcome.code == 1 and "verdict  fail, 12 pads" in outcome.out
    failed = {name for name, pad in pads.items() if pad["verdict"] == "fail"}
    assert failed == {"U1.9", "U1.2", "U1.3", "U1.4", "U1.5"}
    assert pads["U1.4"]["bridged_with"] == "U1.5" and pads["U1.5"]["bridged_with"] == "U1.4"

    def told(name: str, quantity: str) -> tuple[float, float]:
        return float(pads[name][quantity]), float(pads[name][f"{quantity}_sigma"])

    for name, quantity, truth in (("U1.2", "offset_x_percent", 100 * 4e-5 / PASTE[0]), ("U1.2", "offset_y_percent", 0),
                                  ("U1.0", "volume_percent", 100), ("U1.3", "volume_percent", 80), ("U1.9", "volume_percent", 0),
                                  ("U1.10", "volume_percent", 100), ("U1.0", "area_percent", 100)):
        value, sigma = told(name, quantity)
        assert value == pytest.approx(truth, abs=4 * sigma) and sigma < 1, (name, quantity)
    assert report["verdict"] == "fail" and report["datum"]["by"] == "paste"
    assert report["pads"][0]["limits"]["offset_x_percent"] == [-8, 8]
    assert (tmp_path / "b" / "out" / "inspection.png").stat().st_size > 10_000


@pytest.mark.long
def test_marks_tell_an_offset_of_the_whole_print(relit, tmp_path):
    """The layer lies 30 and -18 µm off the print, which the paste alone does not show; holes, in which nothing is seen, show it."""
    height = surface(Print())
    x, y = ((np.arange(length) - (length - 1) / 2) * PIXEL * sign for length, sign in zip(height.shape[::-1], (1, -1), strict=True))
    for hole in HOLES:
        height[np.hypot(x[None] - hole[0], y[:, None] - hole[1]) < BORE / 2] = np.nan
    board = printed(tmp_path / "b", height, 2)
    layer = write_layer(tmp_path / "paste.gbr", moved=(3e-5, -1.8e-5))
    alone, pads, _ = inspect(relit, board, "--paste", layer)
    assert alone.code == 0 and "offset of the whole print is not seen" in alone.out
    assert max(abs(float(pad["offset_x_percent"])) for pad in pads.values()) < 1
    drill = write_drill(tmp_path / "holes.drl", HOLES, BORE)
    outcome, pads, report = inspect(relit, board, "--paste", layer, "--marks", drill)
    assert outcome.code == 0 and report["datum"]["marks_found"] == 3
    for pad in pads.values():
        for axis, truth, side in (("x", -3e-5, PASTE[0]), ("y", 1.8e-5, PASTE[1])):
            value, sigma = (float(pad[f"offset_{axis}_percent{end}"]) for end in ("", "_sigma"))
            assert value == pytest.approx(100 * truth / side, abs=4 * sigma)
    relit("inspect-paste", board, "--paste", layer, "--stencil-m", THICK, "--out", tmp_path / "o", "--device", "cpu", "--marks",
          write_drill(tmp_path / "other.drl", [(0.0, -8.2e-4), (0.0, 0.0)], BORE)).refused("0 of its 2 marks on the board are found")
    assert not (tmp_path / "o").exists()
    # inches declared as millimetres: every mark was found, one pixel wide, in noise; others in the flanks of paste, turned by degrees
    for factor, words in ((1 / 25.4, "marks.drl: its largest mark is 1e-05 m wide"), (0.4, "of its 3 marks|its marks are turned by")):
        marks = write_drill(tmp_path / "marks.drl", [(factor * x, factor * y) for x, y in HOLES], factor * BORE)
        refused = relit("inspect-paste", board, "--paste", layer, "--stencil-m", THICK, "--out", tmp_path / "o", "--device", "cpu",
                        "--marks", marks)
        assert refused.code == 2 and re.search(words, refused.err) and not (tmp_path / "o").exists(), refused.err


@pytest.mark.long
def test_a_board_that_lies_on_its_face_and_elsewhere_is_the_same(relit, tmp_path):
    layer = write_layer(tmp_path / "paste.gbr", pads=[(0.05 - x, y - 0.03) for x, y in PADS])
    _, pads, _ = inspect(relit, printed(tmp_path / "b", surface(Print(shift=(2, 4e-5))), 3), "--paste", layer, "--side", "bottom",
                         "--origin-m", "0.05,-0.03")
    moved = [name for name, pad in pads.items() if float(pad["offset_x_percent"]) > 8]
    assert len(moved) == 1 and float(pads[moved[0]]["x_m"]) == pytest.approx(PADS[2][0], abs=1e-7)


def test_a_pad_that_was_not_seen_is_not_passed(relit, tmp_path):
    height = surface(Print())
    height[30:50, 40:55] = np.nan  # 300 of the 1 200 pixels of an opening
    outcome, pads, _ = inspect(relit, printed(tmp_path / "b", height, 4), "--paste", write_layer(tmp_path / "paste.gbr"),
                               "--limits", limits(tmp_path / "limits.json", fine=[{"pads": "pad [0-9]*", **WIDE}]))
    assert outcome.code == 1 and "verdict  not inspected" in outcome.out
    assert [pad["verdict"] for pad in pads.values()].count("not inspected") == 1


@pytest.mark.long
def test_classes_of_limits_and_pads_without_any(relit, tmp_path):
    board, layer = printed(tmp_path / "b", surface(Print(bridge=(4, 5))), 5), write_layer(tmp_path / "paste.gbr")
    file = limits(tmp_path / "limits.json", one={"pads": "pad *", "bridge": "allow"}, two=[{"pads": "pad 1", "volume_percent": [120, 150]}])
    outcome, _, _ = inspect(relit, board, "--paste", layer, "--limits", file, "--limit-class", "one")
    assert outcome.code == 0 and "verdict  pass" in outcome.out
    outcome, pads, _ = inspect(relit, board, "--paste", layer, "--limits", file, "--limit-class", "two")
    assert outcome.code == 1 and pads["pad 1"]["verdict"] == "fail" and "11 pads are measured and not judged" in outcome.out


@pytest.mark.parametrize(("more", "words"), [
    (("--limits", "LIMITS"), "has the classes one, two"),
    (("--limits", "LIMITS", "--limit-class", "six"), "has no class six"),
    (("--limit-class", "one"), "limit_class is given without limits"),
    (("--origin-m", "1,1"), "lie beyond what was measured"),
    (("--stencil-m", "0.11"), "--stencil-m 0.11: is 0.11 m, more than a stencil has: give metres, such as 0.00011 for 0.11 mm"),
    (("--stencil-m", "110"), "such as 0.00011 for 110 µm"),
    (("--placement-m", "0.1"), "--placement-m: is 0.1 m, and the board is 0.003"),
    (("--pixel-m", "0.012"), "--pixel-m: is 0.012 m, and points of the tiles are 1.2e-05 m apart"),
    (("--origin-m", "0.0004,0.0004"), "does not lie as the openings do"),
    (("--centroids", "PLACES"), "of its components lie beyond the pads"),
])
def test_what_does_not_fit_is_one_sentence(relit, tmp_path, more, words):
    files = {"LIMITS": limits(tmp_path / "limits.json", one=WIDE, two=WIDE), "PLACES": tmp_path / "places.csv"}
    files["PLACES"].write_text("Ref,PosX,PosY\nU1,100,100\n")
    board, layer = printed(tmp_path / "b", surface(Print()), 6), write_layer(tmp_path / "paste.gbr")
    thick = () if "--stencil-m" in more else ("--stencil-m", THICK)
    relit("inspect-paste", board, "--paste", layer, *thick, "--out", tmp_path / "o", "--device", "cpu",
          *(files.get(word, word) for word in more)).refused(words)
    assert not (tmp_path / "o").exists()


@pytest.mark.long
def test_errors_are_as_large_as_their_sigma(tmp_path):
    """Boards without copper: pads at any part of a pixel, on a slope, under noise that is independent. Flanks of a width w about the
    outline of a rectangle hold w² / 3 more, times the thickness."""
    wide = 4e-5
    full = {"volume_percent": 100 * (1 + wide**2 / 3 / np.prod(PASTE)), "area_percent": 100.0}
    grid = BoardGrid(PIXEL, -1.8e-3, 1.2e-3, 200, 300)
    x, y = grid.coordinates(*np.mgrid[: grid.rows, : grid.cols])
    score: dict[str, list[float]] = {"volume_percent": [], "area_percent": [], "x": [], "y": []}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        places = [(px + 1e-5 * rng.standard_normal(), 0.6 * py + 1e-5 * rng.standard_normal()) for px, py in PADS if py != 0]
        pads = read_pads(write_layer(tmp_path / "paste.gbr", pads=places))
        height, off = 3e-3 * x - 2e-3 * y, 2e-5 * rng.standard_normal((len(pads), 2))
        for (px, py), (dx, dy) in zip(places, off, strict=True):
            inside = np.minimum(PASTE[0] / 2 - np.abs(x - px - dx), PASTE[1] / 2 - np.abs(y - py - dy))
            height = height + np.clip(inside / wide + 0.5, 0, 1) * THICK
        noisy = height + SIGMA * rng.standard_normal(height.shape)
        paste = measure_paste(HeightMap(grid, noisy, np.full(height.shape, SIGMA**2), np.zeros(height.shape)), pads, stencil_m=THICK,
                              area_level=0.5, bridge_level=0.4)
        for each, pad, where, move in zip(paste.pads, pads, places, off, strict=True):
            assert pad.centre_m == pytest.approx(np.array(where), abs=1e-8)
            for name, truth in full.items():
                score[name].append((each.values[name].value - truth) / each.values[name].sigma)
            for axis, error, variance in zip("xy", each.offset_m - move, each.offset_variance_m2, strict=True):
                score[axis].append(error / np.sqrt(variance))
    for name, values in score.items():  # the place of an outline is stated for sensors that do not average over a pixel as evenly
        assert (0.05 if name == "area_percent" else 0.2) < np.sqrt(np.mean(np.square(values))) < 1.4, name


def test_areas_of_pads_of_few_pixels_are_those_of_their_paste(tmp_path):
    """Pads of 12 × 16 pixels: medians of 3 × 3 pixels and the interpolation of outlines round their corners, and took 2.4 % of the area."""
    pixel, wide = PASTE[0] / 12, 6e-5
    grid = BoardGrid(pixel, -1.8e-3, 1.2e-3, 80, 120)
    x, y = grid.coordinates(*np.mgrid[: grid.rows, : grid.cols])
    rng = np.random.default_rng(0)
    places = [(px + pixel * rng.random(), py + pixel * rng.random()) for px, py in PADS]
    height = np.zeros(x.shape)
    for px, py in places:
        inside = np.minimum(PASTE[0] / 2 - np.abs(x - px), PASTE[1] / 2 - np.abs(y - py))
        height += np.clip(inside / wide + 0.5, 0, 1) * THICK
    pads = read_pads(write_layer(tmp_path / "paste.gbr", pads=places))
    paste = measure_paste(HeightMap(grid, height, np.full(height.shape, SIGMA**2), np.zeros(height.shape)), pads, stencil_m=THICK,
                          area_level=0.5, bridge_level=0.4)
    areas = np.array([each.values["area_percent"].value for each in paste.pads])
    assert abs(areas.mean() - 100) < 0.5 and np.ptp(areas) < 3  # a sixteenth of a pixel along the outline is 1.9 %


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_tiles_whose_shifts_are_unsure_tell_the_paste_of_whole_pads(relit, tmp_path, seed):
    """Five tiles with two pads each and bare overlaps lie .55 pixels off, as the stage says: volumes were known to 31 %, and all pads
    undecided. Flanks of width w about a rectangle hold w² / 3 more, and the mean above half of the height is less by a quarter of w times
    the outline over twice the area."""
    rng = np.random.default_rng(seed)
    wide, unsure, step = 4e-5, 0.55 * PIXEL, 60 * PIXEL
    places = [((number - 2) * step, y) for number in range(5) for y in (-4e-4, 4e-4)]
    thick = [0.7 if number == 3 else 1.0 for number in range(10)]
    entries = []
    for tile in range(5):
        x, y = np.meshgrid((np.arange(72) - 35.5) * PIXEL + (tile - 2) * step + unsure * rng.standard_normal(),
                           (79.5 - np.arange(160)) * PIXEL + unsure * rng.standard_normal())
        height = SIGMA * rng.standard_normal(x.shape) + 1e-6 * rng.standard_normal()
        for (px, py), part in zip(places, thick, strict=True):
            inside = np.minimum(PASTE[0] / 2 - np.abs(x - px), PASTE[1] / 2 - np.abs(y - py))
            height += np.clip(inside / wide + 0.5, 0, 1) * part * THICK
        write_depth(tmp_path / str(tile) / "depth.exr", height, sigma=SIGMA, pixel=PIXEL)
        entries.append({"path": str(tile), "position_m": [(tile - 2) * step, 0.0]})
    (tmp_path / "board.json").write_text(json.dumps({"schema": "relit.board-scan/1", "name": "row", "stage_sigma_m": unsure,
                                                     "tiles": entries}))
    _, pads, _ = inspect(relit, tmp_path, "--paste", write_layer(tmp_path / "paste.gbr", pads=places),
                         "--limits", limits(tmp_path / "limits.json", fine={**WIDE, "offset_percent": 25}))
    assert [pad["verdict"] for pad in pads.values()] == ["fail" if part < 1 else "pass" for part in thick]
    rim = wide * (PASTE[0] + PASTE[1]) / np.prod(PASTE)
    for pad, part in zip(pads.values(), thick, strict=True):
        truths = {"volume_percent": 100 * part * (1 + wide**2 / 3 / np.prod(PASTE))}
        if part == 1:
            truths |= {"area_percent": 100.0, "height_percent": 100 * (1 - rim / 4)}
        for name, truth in truths.items():
            sigma = float(pad[f"{name}_sigma"])
            assert abs(float(pad[name]) - truth) < 3 * sigma < 12, name


def test_paste_that_fits_its_openings_at_several_places_is_refused():
    """Six pads of one pitch, and openings for the four in the middle."""
    grid, height = BoardGrid(1e-5, 0.0, 0.0, 40, 120), np.zeros((40, 120))
    openings = np.zeros(height.shape, dtype=bool)
    for number in range(6):
        height[12:28, 8 + 18 * number : 18 + 18 * number] = 1e-4
        openings[12:28, 8 + 18 * number : 18 + 18 * number] = 1 <= number <= 4
    seen = HeightMap(grid, np.roll(height, (2, -3), axis=(0, 1)), np.full(height.shape, 1e-12), np.zeros(height.shape))
    assert lay(seen, openings, stencil_m=1e-4, search_px=8, apart_px=5) == pytest.approx([3e-5, 2e-5])
    with pytest.raises(BoardError, match=r"differ by 0\.00018 m fit its openings alike"):
        lay(seen, openings, stencil_m=1e-4, search_px=22, apart_px=5)


def test_a_board_that_lies_turned_or_mirrored_is_refused_by_name():
    grid, height = BoardGrid(1e-5, 0.0, 0.0, 60, 80), np.zeros((60, 80))
    height[8:20, 10:30] = height[35:50, 12:20] = height[10:24, 50:60] = 1e-4
    for seen, words in ((height[::-1, ::-1], "turned by 180°"), (height[:, ::-1], "mirrored")):
        board = HeightMap(grid, seen, np.full(seen.shape, 1e-12), np.zeros(seen.shape))
        with pytest.raises(BoardError, match=words):
            lay(board, height > 0, stencil_m=1e-4, search_px=8, apart_px=5)


@pytest.mark.parametrize(("volume", "area", "scale", "told", "words"), [
    (1.0, 1.0, 1.0, None, ""), (0.93, 0.97, 1.0, None, ""), (1.25, 1.03, 1.0, 125, "of the volume"), (1.5, 1.14, 1.0, 150, "of the volume"),
    (0.64, 0.62, 1.0, 62, "of the area"), (1.0, 1.0, 1.006, 1.006, "times as far apart")])
def test_what_all_pads_share_is_said(volume, area, scale, told, words):
    """Twelve pads of which each differs by 3 % and lies 3 µm off, on a board 4 mm wide with pixels of 12 µm: the median of the first is
    known to 1 %, the scale to .0005; both are within three times that."""
    rng = np.random.default_rng(8)
    places = rng.uniform(-2e-3, 2e-3, (12, 2))
    each = 100 * (1 + 0.03 * rng.standard_normal(12))
    offsets = (scale - 1) * places + 3e-6 * rng.standard_normal((12, 2)) + [2e-5, -1e-5]
    said = shared_sentences(volume * each, area * each, places, offsets, pixel_m=1.2e-5)
    assert len(said) == (told is not None) and all(words in sentence for sentence in said), said
    if told is not None:
        number = float(re.search(r"[0-9.]+", said[0])[0])
        assert number == pytest.approx(told, abs=0.0015 if scale > 1 else 0.03 * told)
    assert shared_sentences(volume * each[:5], area * each[:5], places[:5], offsets[:5], pixel_m=1.2e-5) == []


def test_a_mark_is_found_to_a_part_of_a_pixel_and_a_datum_leaves_out_one_that_is_off():
    grid, rng = BoardGrid(1e-5, 0.0, 0.0, 120, 120), np.random.default_rng(7)
    x, y = grid.coordinates(*np.mgrid[:120, :120])
    truth = np.array([6.13e-4, -5.84e-4])
    copper = 2e-5 * np.clip((2e-4 - np.hypot(x - truth[0], y - truth[1])) / 1e-5 + 0.5, 0, 1)
    seen = HeightMap(grid, copper + 2e-6 * rng.standard_normal(x.shape), np.full(x.shape, 4e-12), np.zeros(x.shape))
    found = find_mark(seen, np.array([5.9e-4, -6.0e-4]), 4e-4, deep_m=1e-4, search_m=5e-5)
    assert found == pytest.approx(truth - [5.9e-4, -6.0e-4], abs=1e-6)
    flat = seen._replace(height=2e-6 * rng.standard_normal(x.shape))
    assert find_mark(flat, np.array([5.9e-4, -6.0e-4]), 4e-4, deep_m=1e-4, search_m=5e-5) is None
    places = rng.uniform(-1e-2, 1e-2, (8, 2))
    offsets = np.array([2e-5, -1e-5]) + 1e-3 * (places - places.mean(axis=0)) @ np.array([[0, 1], [-1, 0]])
    offsets[3] += 1e-4
    datum = fit_datum(places, offsets, pixel_m=1e-6)
    assert datum.at(places[0]) == pytest.approx(offsets[0], abs=2e-7) and datum.turn == pytest.approx(1e-3, abs=2e-5)


def test_capability_is_that_of_the_formulas(relit, tmp_path):
    """Five boards with 96, 98, 100, 102 and 104 %: σ = √10; a second run of one board counts as its mean."""
    runs = []
    for number, value in enumerate((96, 98, 100, 102, 103.5, 104.5)):
        (tmp_path / f"r{number}").mkdir()
        pad = {"name": "U1.1", "volume_percent": value, "offset_x_percent": None,
               "limits": {"volume_percent": [85, 115], "offset_x_percent": [-9, 9]}}
        (tmp_path / f"r{number}" / "report.json").write_text(json.dumps({"pads": [pad]}))
        runs.append({"result": f"r{number}", "board": f"board {min(number, 4)}"})
    (tmp_path / "study.json").write_text(json.dumps({"schema": "relit.gauge-study/1", "name": "pads", "runs": runs}))
    outcome = relit("board-capability", tmp_path / "study.json", "--out", tmp_path / "out")
    assert outcome.code == 0 and "U1.1 volume percent: Cpk 1.58" in outcome.out and "left out 1" in outcome.out
    row, = csv.DictReader((tmp_path / "out" / "capability.csv").open())
    assert float(row["cp"]) == pytest.approx(30 / 6 / np.sqrt(10), rel=1e-5) == float(row["cpk"])
    uneven = capability(("a", "b"), np.array([1.0, 2.0, 3.0]), (0.0, 6.0))
    assert (uneven.cp, uneven.cpk) == pytest.approx((1.0, 2 / 3))
    assert uneven.cpk_bound == pytest.approx(2 / 3 - 1.644854 * np.sqrt(1 / 27 + 4 / 9 / 4), rel=1e-4)
    (tmp_path / "r0" / "report.json").write_text("{}")
    assert "is no report of relit inspect-paste" in relit.refused("board-capability", tmp_path / "study.json", "--out", tmp_path / "o")
