"""Boards inspected: files, verdicts and findings."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from service.boards.findings import find_defects
from service.boards.height_files import read_golden
from service.boards.stitching.form import fit_form
from service.boards.stitching.grid import BoardGrid, HeightMap
from service.boards.stitching.regions import too_wide
from service.boards.stitching.significance import compare, scan_windows
from service.boards.tiles import without_spikes
from stage.errors import ResultError
from stage.formats import exr
from stage.sets.board import Region
from tests.marks import first_short
from tests.scenes.board import PIXEL, SIGMA, domes, scan, write_scan
from tests.scenes.captures import write_exr
from tests.scenes.depth import BLACK_WHITE, CAMERA, gray_patterns, make_scene, phase_patterns, write_patterns

SIDE, STEP = (120, 130), (1.0e-3, 0.9e-3)
SQUARE, DISC = (3.0e-4, 2.0e-4), (-4.0e-4, -3.5e-4)
"""Where the defects are: a square of 5 x 5 pixels and a disc of 8 pixels radius, each 5 σ high or deep."""
SURFACE = domes(4e-3, 4e-3, bow=5e-5)
GRID = BoardGrid(8e-5, 0.0, 0.01, 130, 150)
NOISE = 4e-6
ROWS, COLS = slice(40, 91), slice(60, 102)
"""The chip: 42 x 51 pixels, 3.4 x 4.1 mm."""


def faulty(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    square = (np.abs(x - SQUARE[0]) < 2.5 * PIXEL) & (np.abs(y - SQUARE[1]) < 2.5 * PIXEL)
    return SURFACE(x, y) + 5 * SIGMA * square - 5 * SIGMA * (np.hypot(x - DISC[0], y - DISC[1]) < 8 * PIXEL)


def board(folder: Path, surface, *, seed: int, across: int = 2, down: int = 2, **options) -> Path:
    return write_scan(folder, scan(surface, across=across, down=down, side=SIDE, step=STEP, seed=seed, stage=PIXEL, **options))


@pytest.fixture(scope="module")
def golden(tmp_path_factory) -> Path:
    """The result folder of a good board."""
    from service.boards.inspect_board import inspect_board
    from service.requests.inspect_board import InspectBoardRequest

    folder = tmp_path_factory.mktemp("golden")
    result = inspect_board(InspectBoardRequest(board=board(folder / "scan", SURFACE, seed=1), out=folder / "out", device="cpu"))
    assert result.verdict is None and result.findings_path is None
    return folder / "out"


def inspect(relit, scan_folder: Path, *arguments):
    """The outcome, the rows of the table and the report of a run that is compared with something."""
    out = scan_folder / "out"
    outcome = relit("inspect-board", scan_folder, "--out", out, "--device", "cpu", *arguments)
    if not (out / "report.json").exists():
        return outcome, [], {}
    with open(out / "findings.csv", newline="") as table:
        return outcome, list(csv.DictReader(table)), json.loads((out / "report.json").read_text())


@pytest.mark.long
def test_planted_defects_are_found_and_nothing_else(relit, tmp_path, golden):
    """The defects lie in the frame of the golden board, whose stage errs by up to a pixel."""
    outcome, rows, report = inspect(relit, board(tmp_path / "b", faulty, seed=2), "--golden", golden)
    assert outcome.code == 1 and "verdict  fail" in outcome.out
    defects = [row for row in rows if row["kind"] == "defect"]
    assert len(defects) == 2
    for centre, side, sign in ((SQUARE, 5, 1), (DISC, 16, -1)):
        row = min(defects, key=lambda row: np.hypot(float(row["x_m"]) - centre[0], float(row["y_m"]) - centre[1]))
        assert np.hypot(float(row["x_m"]) - centre[0], float(row["y_m"]) - centre[1]) < 2 * PIXEL
        assert float(row["width_m"]) == pytest.approx(side * PIXEL, abs=2.5 * PIXEL)
        assert float(row["height_m"]) == pytest.approx(side * PIXEL, abs=2.5 * PIXEL)
        assert float(row["deviation_m"]) == pytest.approx(sign * 5 * SIGMA, abs=4 * float(row["sigma_m"]) + 0.5 * SIGMA)
        assert float(row["significance"]) > report["comparison"]["windows"]["threshold_sigma"]
    channels, _ = exr.read(tmp_path / "b" / "out" / "deviation.exr")
    assert set(channels) == {"deviation.Z", "sigma.Z", "score.Y", "mask.Y", "defect.Y"}
    assert (tmp_path / "b" / "out" / "inspection.png").stat().st_size > 10_000


@pytest.mark.long
def test_a_good_board_with_missing_pixels_does_not_pass_as_a_whole(relit, tmp_path, golden):
    views = scan(SURFACE, across=2, down=2, side=SIDE, step=STEP, seed=3, stage=PIXEL)
    views[0].height[40:60, 30:45] = np.nan
    outcome, rows, report = inspect(relit, write_scan(tmp_path / "b", views), "--golden", golden, "--tolerance-m", "1e-6")
    assert outcome.code == 1 and "verdict  not inspected" in outcome.out
    assert not [row for row in rows if row["kind"] == "defect"]
    hole = next(row for row in rows if row["kind"] == "area" and abs(float(row["width_m"]) - 15 * PIXEL) < 3 * PIXEL
                and abs(float(row["height_m"]) - 20 * PIXEL) < 3 * PIXEL)
    told = views[0].told
    assert float(hole["x_m"]) == pytest.approx(told[0] - 27.5 * PIXEL, abs=4 * PIXEL)
    assert float(hole["y_m"]) == pytest.approx(told[1] + 10 * PIXEL, abs=4 * PIXEL)
    assert report["comparison"]["pixels"]["not_inspected"] >= 300
    passed, _, _ = inspect(relit, tmp_path / "b", "--golden", golden, "--least-inspected", "0.9")
    assert passed.code == 0 and "verdict  pass" in passed.out


@pytest.mark.long
def test_what_must_be_found_and_cannot_is_not_inspected(relit, tmp_path, golden):
    """The smallest window has a σ of √2 / 3 σ: a defect of 3 σ in it cannot be told at 5.8 + 1.6 of that, one of 5 σ can."""
    folder = board(tmp_path / "b", SURFACE, seed=4)
    assert inspect(relit, folder, "--golden", golden, "--must-find-m", "5e-6")[2]["comparison"]["pixels"]["inspected"] > 30_000
    outcome, _, report = inspect(relit, folder, "--golden", golden, "--must-find-m", "2e-6")
    assert outcome.code == 1 and report["comparison"]["pixels"]["inspected"] < 15_000


@pytest.mark.long
def test_regions_of_a_design_are_decided(relit, tmp_path):
    """The design is the exact surface; regions over both defects fail, one beside them passes, one without tiles is not inspected."""
    rows, cols = 210, 230
    top_left = (-cols / 2 * PIXEL, rows / 2 * PIXEL)
    x, y = np.meshgrid(top_left[0] + (np.arange(cols) + 0.5) * PIXEL, top_left[1] - (np.arange(rows) + 0.5) * PIXEL)
    folder = board(tmp_path / "b", faulty, seed=5)
    write = {"compression": exr.Compression.ZIP}
    exr.write(tmp_path / "b" / "design.exr", {"height.Z": SURFACE(x, y).astype(np.float32)}, color_space=exr.DATA, metadata={}, **write)

    def pad(name, centre, size, **changes):
        return {"name": name, "shape": "rectangle", "centre_m": centre, "size_m": size, "tolerance_m": [-2e-6, 2e-6], **changes}

    regions = [pad("square", SQUARE, [4e-5, 4e-5]), pad("disc", DISC, [1.2e-4, 1.2e-4], shape="circle"),
               pad("good", [0.0, 4e-4], [1e-4, 1e-4]), pad("loose", SQUARE, [4e-5, 4e-5], tolerance_m=[-2e-5, 2e-5]),
               pad("edge", [-1.1e-3, 0.0], [1e-4, 1e-4])]
    design = {"schema": "relit.board-design/1", "name": "board", "regions": regions,
              "height_map": {"path": "design.exr", "resolution": [cols, rows], "pixel_m": PIXEL, "top_left_m": top_left}}
    (tmp_path / "b" / "design.json").write_text(json.dumps(design))
    outcome, rows_, report = inspect(relit, folder, "--design", folder / "design.json", "--tolerance-m", "1e-5")
    assert outcome.code == 1, outcome
    verdicts = {row["name"]: row["verdict"] for row in rows_ if row["kind"] == "region"}
    assert verdicts == {"square": "fail", "disc": "fail", "good": "pass", "loose": "pass", "edge": verdicts["edge"]}
    assert not [row for row in rows_ if row["kind"] == "defect"]  # 5 σ are within 10 µm
    fails = {entry["name"]: entry for entry in report["regions"]}
    assert fails["disc"]["deviation_m"] == pytest.approx(-5 * SIGMA, abs=4 * fails["disc"]["sigma_m"] + 0.2 * SIGMA)
    design["height_map"]["pixel_m"] = PIXEL * 1e3
    (tmp_path / "b" / "design.json").write_text(json.dumps(design | {"regions": []}))
    refused = relit.refused("inspect-board", folder, "--design", folder / "design.json", "--out", tmp_path / "o", "--device", "cpu")
    assert "design.json: is not of this board" in refused


@pytest.mark.long
def test_regions_of_a_golden_board_are_decided(relit, tmp_path, golden):
    """As those of a design; without a golden board there is nothing to judge them on."""
    folder, file = board(tmp_path / "b", faulty, seed=5), tmp_path / "regions.json"
    regions = [{"name": name, "shape": "rectangle", "centre_m": centre, "size_m": [4e-5, 4e-5], "tolerance_m": [-2e-6, 2e-6]}
               for name, centre in (("square", SQUARE), ("good", [0.0, 4e-4]))]
    file.write_text(json.dumps({"schema": "relit.board-regions/1", "regions": regions}))
    outcome, rows, report = inspect(relit, folder, "--golden", golden, "--regions", file, "--tolerance-m", "1e-5")
    assert outcome.code == 1, outcome
    assert {row["name"]: row["verdict"] for row in rows if row["kind"] == "region"} == {"square": "fail", "good": "pass"}
    assert "regions" in report["inputs"] and not report["defects"]  # 5 σ are within 10 µm
    assert "regions are given without golden" in relit.refused("inspect-board", folder, "--regions", file, "--out", tmp_path / "o")
    file.write_text(json.dumps({"schema": "relit.board-regions/1", "regions": [regions[0], regions[0]]}))
    twice = relit("inspect-board", folder, "--golden", golden, "--regions", file, "--out", tmp_path / "o")
    assert twice.code == 2 and "regions: the name square is given twice" in twice.err
    file.write_text(json.dumps({"schema": "relit.board-regions/1", "regions": [regions[0] | {"centre_m": [1.0, 0.0]}]}))
    beyond = relit("inspect-board", folder, "--golden", golden, "--regions", file, "--out", tmp_path / "o", "--device", "cpu")
    assert beyond.code == 2 and "square lies beyond the height map" in beyond.err and not (tmp_path / "o").exists()


@pytest.mark.long
@pytest.mark.parametrize(("surface", "options", "words"), [
    (domes(4e-3, 4e-3, seed=9), {}, "is not of this board: the correlation of their heights"),
    (lambda x, y: SURFACE(-x, y), {}, "the board is mirrored against it"),
    (lambda x, y: 1e3 * SURFACE(x, y), {"sigma": 1e3 * SIGMA}, "its heights span .* as millimetres taken for metres do"),
    (SURFACE, {"across": 4, "down": 3}, "it covers 4[0-9] % of what was measured"),
    (SURFACE, {"across": 1, "down": 1}, "of its pixels were measured"),
], ids=["another board", "mirrored", "millimetres", "larger", "smaller"])
def test_a_golden_map_that_does_not_fit_is_one_sentence(relit, tmp_path, golden, surface, options, words):
    folder = board(tmp_path / "b", surface, seed=6, **options)
    assert re.search(words, relit.refused("inspect-board", folder, "--golden", golden, "--out", tmp_path / "o", "--device", "cpu"))
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(("change", "words"), [
    ({"schema": "relit.board-scan/2"}, "schema: is \"relit.board-scan/2\", this program reads"),
    ({"tiles": []}, "tiles: has 0 entries, needs 1 or more"),
    ({"tiles": [{"path": "tile_00"}, {"path": "tile_00"}]}, "tiles: tile_00 is given twice"),
    ({"tiles": [{"path": "../tile_00"}]}, "../tile_00 leads out of the folder"),
    ({"tiles": [{"path": "tile_00"}]}, "position_m is missing, and so is world_from_camera"),
    ({"tiles": [{"path": "nothing", "position_m": [0, 0]}]}, "nothing holds neither depth.exr nor capture.json"),
    ({"stage_sigma": 1e-5}, "stage_sigma: is not a known key"),
    ({"stage_sigma_m": 20}, "stage_sigma_m: is 20 m, and tiles are 0.00"),  # micrometres: a search over 900 TiB
])
def test_a_bad_board_file_is_one_sentence(relit, tmp_path, change, words):
    folder = board(tmp_path / "b", SURFACE, seed=7, across=1, down=1)
    data = json.loads((folder / "board.json").read_text()) | change
    (folder / "board.json").write_text(json.dumps(data))
    said = relit.refused("inspect-board", folder, "--out", tmp_path / "o", "--device", "cpu")
    assert words in said and "board.json" in said and not (tmp_path / "o").exists()


def test_a_golden_that_was_not_inspected_is_named(tmp_path):
    with pytest.raises(ResultError, match=r"board\.exr: is not there: run `relit inspect-board` first"):
        read_golden(tmp_path)


def test_tiles_without_sigma_and_designs_of_another_size_are_refused(relit, tmp_path):
    folder = board(tmp_path / "b", SURFACE, seed=8, across=1, down=1)
    write_exr(folder / "design.exr", np.zeros((20, 30, 3)))
    design = {"schema": "relit.board-design/1", "name": "d", "height_map": {
        "path": "design.exr", "resolution": [30, 21], "pixel_m": PIXEL, "top_left_m": [0, 0]}}
    (folder / "design.json").write_text(json.dumps(design))
    outcome = relit("inspect-board", folder, "--design", folder / "design.json", "--out", tmp_path / "o", "--device", "cpu")
    assert outcome.code == 2 and "design.exr has 30x20 pixels, resolution says 30x21" in outcome.err
    channels, metadata = exr.read(folder / "tile_00" / "depth.exr")
    channels.pop("sigma.Z")
    exr.write(folder / "tile_00" / "depth.exr", channels, color_space=exr.DATA, metadata={"relit:camera": metadata["relit:camera"]})
    relit("inspect-board", folder, "--out", tmp_path / "o", "--device", "cpu").refused("tiles[0] (tile_00): its depth has no layer sigma.Z")


def test_a_capture_is_a_tile_too(relit, tmp_path):
    """A tilted plane under Gray code and phase shifting, seen in perspective: the board is flat within the noise that its σ says."""
    patterns = [*gray_patterns("column", stripe=8), *phase_patterns("column", 16.0), *BLACK_WHITE]
    write_patterns(tmp_path / "tile", make_scene(sphere=False), patterns, noise=0.002)
    (tmp_path / "board.json").write_text(json.dumps({"schema": "relit.board-scan/1", "name": "plane",
                                                     "tiles": [{"path": "tile", "position_m": [0, 0]}]}))
    outcome = relit.done("inspect-board", tmp_path, "--out", tmp_path / "out", "--device", "cpu")
    channels, _ = exr.read(tmp_path / "out" / "board.exr")
    there = channels["mask.Y"] > 0.5
    assert there.sum() > 0.7 * CAMERA.width * CAMERA.height
    normal = channels["height.Z"][there] / channels["sigma.Z"][there]
    # the depth's own scatter about the best plane is .21 of its σ; more would be a plane that is not the best
    assert 0.15 < 1.4826 * np.median(np.abs(normal - np.median(normal))) < 0.3
    assert "single tile" in outcome.out


def board_of(seed, *, chip=True, shared=0.0, outliers=0.0, warp=0.0):
    """A measured board with chips of vertical walls, blurred by optics; `shared` is the part of the noise that neighbours share."""
    rng = np.random.default_rng(seed)
    height = np.zeros((GRID.rows, GRID.cols))
    height[ROWS, COLS] = 7e-4 * chip
    height[15:30, 10:120], height[100:120, 20:50] = 4e-4, 1.1e-3
    height = gaussian_filter(height, 0.7)
    rough = gaussian_filter(rng.standard_normal((GRID.rows + 32, GRID.cols + 32)), 2.0)[16:-16, 16:-16]  # as strong at the borders
    noise = np.sqrt(1 - shared) * rng.standard_normal(height.shape) + np.sqrt(shared) * rough / rough.std()
    x, y = np.meshgrid(np.linspace(-1, 1, GRID.cols), np.linspace(-1, 1, GRID.rows))
    height = height + NOISE * noise + warp * (x * y + 0.3 * x**3 - 0.2 * x * y * y)
    height = np.where(rng.random(height.shape) < outliers, height + rng.uniform(-1e-3, 1e-3, height.shape), height)
    told, sigma = without_spikes(height.ravel(), np.full(height.size, NOISE), np.ones(height.shape, bool))
    return HeightMap(GRID, told.reshape(height.shape), sigma.reshape(height.shape) ** 2, np.zeros(height.shape))


def defects(measured, golden, *, shift_sigma_m=0.0):
    deviation = compare(measured, golden, shift_sigma_m=(shift_sigma_m, shift_sigma_m))
    deviation = deviation._replace(height=deviation.height - fit_form(GRID, deviation.height, quadratic=True).over(GRID))
    scan = scan_windows(deviation, tolerance_m=0.0, false_alarm=0.01, smallest_px=3)
    return find_defects(deviation, scan, np.zeros(deviation.height.shape))


def test_a_missing_chip_is_listed_as_large_and_deep_as_it_is():
    """Pixels at the walls are half as deep: the outline is known to a pixel, and the volume to that of a pixel's rim."""
    found, pixels = defects(board_of(1, chip=False, shared=0.5), board_of(2, shared=0.5))
    assert len(found) == 1
    area, chip = found[0].area, 51 * 42
    assert area.width_m == pytest.approx(42 * GRID.pixel_m, abs=2 * GRID.pixel_m)
    assert area.height_m == pytest.approx(51 * GRID.pixel_m, abs=2 * GRID.pixel_m)
    assert area.pixels == pixels.sum() == pytest.approx(chip, abs=2 * (51 + 42))
    assert found[0].deviation_m == pytest.approx(-7e-4, abs=5e-6) and found[0].peak_m == pytest.approx(-7e-4, abs=3 * NOISE)
    assert found[0].volume_m3 == pytest.approx(area.area_m2 * found[0].deviation_m, rel=0.05)
    assert found[0].significance == pytest.approx(abs(found[0].deviation_m) / found[0].sigma_m)


@first_short("changes", [{}, {"shared": 0.6}, {"outliers": 0.01}, {"warp": 3e-5},
                                     {"shared": 0.4, "outliers": 0.004, "warp": 1e-5}], ids=["noise", "shared", "outliers", "warp", "all"])
def test_a_good_board_has_no_defect(changes):
    """Four boards: at 1 % false alarms, one in 25 sets of four would show one by chance."""
    golden = board_of(10, **changes)
    assert [defect for seed in range(4) for defect in defects(board_of(20 + seed, **changes), golden)[0]] == []


def test_a_small_defect_is_found_under_noise_that_neighbours_share():
    measured = board_of(30, shared=0.3)
    measured.height[70:74, 120:124] += 12 * NOISE
    found, _ = defects(measured, board_of(31, shared=0.3))
    assert len(found) == 1 and found[0].area.pixels == pytest.approx(16, abs=4)


def test_a_narrow_chip_is_found_though_each_of_its_pixels_is_near_a_wall():
    """What may be misplaced there is shared by all, and is no noise that scatters more than the σ says."""
    golden, chip = board_of(40, shared=0.5, warp=1e-5), np.zeros((GRID.rows, GRID.cols))
    chip[60:90, 125:130] = 1.2e-3
    golden.height[...] += gaussian_filter(chip, 0.7)
    found, _ = defects(board_of(41, shared=0.5, warp=1e-5), golden, shift_sigma_m=4e-5)
    assert found[0].deviation_m == pytest.approx(-1.2e-3, rel=0.1) and found[0].area.pixels == pytest.approx(150, abs=35)


def test_outliers_side_by_side_are_none_and_lines_and_squares_stay():
    """A hundredth of the pixels are outliers, so that two and three come together; a line and a square of three are something."""
    rng = np.random.default_rng(50)
    truth = np.zeros((120, 140))
    truth[30:33, 40:43], truth[80, 20:60] = 20 * NOISE, 20 * NOISE
    seen = truth + NOISE * rng.standard_normal(truth.shape)
    wild = (rng.random(truth.shape) < 0.01) & (truth == 0)
    wild[60, 70:73] = wild[10:12, 100] = wild[100:102, 90:92] = True
    seen[wild] -= 15 * NOISE
    used = (rng.random(truth.shape) > 0.002) | (truth > 0)
    told, sigma = without_spikes(seen[used].astype(np.float32), np.full(used.sum(), NOISE), used)
    image, wide = np.full(truth.shape, np.nan), np.full(truth.shape, np.nan)
    image[used], wide[used] = told, sigma
    groups = np.zeros(truth.shape, dtype=bool)
    groups[60, 70:73] = groups[10:12, 100] = groups[100:102, 90:92] = True
    assert np.nanmax(np.abs(image[groups])) < 5 * NOISE and np.nanmin(wide[groups]) > 8 * NOISE
    assert image[30:33, 40:43].min() > 15 * NOISE and image[80, 22:58].min() > 15 * NOISE


@pytest.mark.parametrize(("tolerance", "elsewhere", "words"), [
    (2e-5, 0.0, None), (2e-2, 0.0, "regions: 1, as U1, allow -0.02 to 0.02 m"), (20.0, 0.0, "allow -20 to 20 m"),
    (2e-5, 5e-5, None), (2e-5, 0.05, "--tolerance-m allows 0.05 m")])
def test_limits_in_another_unit_are_said(tolerance, elsewhere, words):
    """A board with 100 µm of relief and a region of 1 mm; micrometres and millimetres in place of metres let anything pass."""
    height = np.zeros((GRID.rows, GRID.cols))
    height[ROWS, COLS] = 1e-4
    nominal = HeightMap(GRID, height, np.zeros_like(height), np.zeros_like(height))
    region = Region(name="U1", shape="rectangle", centre_m=(4e-3, 6e-3), size_m=(1e-3, 1e-3), tolerance_m=(-tolerance, tolerance))
    said = too_wide(nominal, [region], elsewhere_m=elsewhere, smallest_m=2.4e-4)
    assert said == [] if words is None else (len(said) == 1 and words in said[0])
