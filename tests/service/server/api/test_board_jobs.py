"""Boards as jobs: captures are the tiles of an uploaded folder, and a board is compared with the result of another job."""

import json

import numpy as np
import pytest

from service.calibrate.stereo import stereo
from service.requests.base.identifiers import new_id
from service.requests.calibrate import StereoRequest
from stage.results.depth_maps import DepthMaps
from tests.scenes import stereo as scenes
from tests.scenes.board import write_depth
from tests.scenes.depth import BLACK_WHITE, gray_patterns, make_scene, phase_patterns, write_patterns
from tests.scenes.projected import Wall
from tests.scenes.stereo import POSE
from tests.service.calibrate.test_procam import write_board
from tests.service.depth.stereo.test_two_cameras import two_captures
from tests.service.server.api.job_calls import NOBODY, error_of, finish, finished, made_by, refused, report_of, result, submit
from tests.service.server.api.test_calibrating import sent
from tests.service.server.api.test_measuring import files_of, upload

OTHER = new_id("job")


def scanned(folder, seed: int) -> dict[str, bytes]:
    """A board of one tile: a tilted plane under Gray code and phase shifting."""
    patterns = [*gray_patterns("column", stripe=8), *phase_patterns("column", 16.0), *BLACK_WHITE]
    write_patterns(folder / "tile", make_scene(sphere=False), patterns, noise=0.002, seed=seed)
    board = {"schema": "relit.board-scan/1", "name": "plane", "tiles": [{"path": "tile", "position_m": [0, 0]}]}
    (folder / "board.json").write_text(json.dumps(board))
    return files_of(folder)


@pytest.fixture(scope="module")
def tile(tmp_path_factory) -> dict[str, bytes]:
    return scanned(tmp_path_factory.mktemp("board"), seed=0)


@pytest.fixture(scope="module")
def board(server, client, tile) -> dict:
    return upload(server, client, tile)


@pytest.fixture(scope="module")
def golden(server, client, board) -> dict:
    return finished(server, client, kind="inspect-board", capture=board["id"])


@pytest.mark.long
def test_a_board_is_compared_with_the_result_of_a_job(server, client, board, golden):
    """The same images pass against themselves but for what has no depth."""
    assert board["facts"]["tiles"] == 1
    assert made_by(client, golden) == {"board.exr", "inspection.png", "report.json"}
    job = finished(server, client, kind="inspect-board", capture=board["id"], golden=golden["id"], options={"least_inspected": 0.5})
    assert made_by(client, job) == {"board.exr", "deviation.exr", "findings.csv", "inspection.png", "report.json"}
    report = report_of(server, client, job)
    assert report["comparison"]["verdict"] == "pass" and report["defects"] == []
    assert report["comparison"]["pixels"]["inspected"] > 1000
    depth = submit(client, kind="depth", capture=board["id"])
    assert "capture.json" in finish(server, client, depth, "failed")["error"]
    other = client.post("/v1/jobs", json={"kind": "inspect-board", "capture": board["id"], "golden": depth["id"]})
    refused(other, 422, "is a depth job: give one of inspect-board")


REGIONS = {"schema": "relit.board-regions/1", "regions": [
    {"name": name, "shape": "rectangle", "centre_m": [x, 0.0], "size_m": [0.2, 0.2], "tolerance_m": [-0.01, 0.01]}
    for name, x in (("left", -0.3), ("right", 0.3))]}


def study(*results: str, operators: int = 1) -> dict:
    runs = [{"result": result, "board": "plane", "operator": f"station {number % operators}"} for number, result in enumerate(results)]
    return {"schema": "relit.gauge-study/1", "name": "pads", "runs": runs}


@pytest.mark.long
def test_inspections_of_regions_are_studied_and_boards_that_cannot_be_are_refused(server, client, tile, board, golden, tmp_path):
    """Two inspections of one board that differ in the noise of their images, and one of the first images again: a copy."""
    options = {"least_inspected": 0.5}
    again = upload(server, client, scanned(tmp_path / "again", seed=1))
    runs = [submit(client, kind="inspect-board", capture=each["id"], golden=golden["id"], regions=REGIONS, options=options)["id"]
            for each in (board, again, board)]
    for run in runs:
        finish(server, client, {"id": run})
    copy = runs.pop()
    assert "regions.json" in made_by(client, {"id": runs[0]})
    inspected = report_of(server, client, {"id": runs[0]})
    assert [region["name"] for region in inspected["regions"]] == ["left", "right"]
    assert all(abs(region["deviation_m"]) < 1e-6 for region in inspected["regions"])  # board.exr has floats, of heights of 0.1 m
    job = finished(server, client, kind="gauge-board", study=study(*runs))
    assert made_by(client, job) == {"gauge.csv", "report.json"}
    report = report_of(server, client, job)
    assert (report["study"]["parts"], report["study"]["trials"], report["inputs"]["name"]) == (2, 2, "pads")
    assert 0 < report["study"]["repeatability_m"] < 1e-3 and report["study"]["narrowest_tolerance_m"] == pytest.approx(0.02)
    copied = error_of(server, client, kind="gauge-board", study=study(runs[0], copy))
    assert copied.startswith(f"study.json: runs: {copy} has the same values as {runs[0]}")
    assert report["inputs"]["study"] == f"{job['id']}/study.json"
    in_use = client.post("/v1/jobs", json={"kind": "gauge-board", "study": study(golden["id"], runs[0])})
    refused(in_use, 422, f"study.runs[0].result: {golden['id']} inspected a board without regions")
    assert "2 parts and 1 trials" in error_of(server, client, kind="gauge-board", study=study(*runs, operators=2))
    unfit = {**REGIONS, "regions": [REGIONS["regions"][0] | {"centre_m": [30.0, 0.0]}]}
    assert "left lies beyond the height map" in error_of(
        server, client, kind="inspect-board", capture=board["id"], golden=golden["id"], regions=unfit, options=options)
    away = upload(server, client, tile | {"board.json": tile["board.json"].replace(b'"tile"', b'"../tile"')}, "refused")
    assert "leads out of the folder of the file" in away["problem"]
    empty = upload(server, client, {"board.json": tile["board.json"]}, "refused")
    assert "tile/capture.json is no file" in empty["problem"]
    write_depth(tmp_path / "depth.exr", np.zeros((20, 20)))
    depth = upload(server, client, tile | {"tile/depth.exr": (tmp_path / "depth.exr").read_bytes()}, "refused")
    assert "the service takes captures as tiles" in depth["problem"]


def test_studies_that_cannot_be(client):
    def ask(**request):
        return client.post("/v1/jobs", json=request)

    refused(ask(kind="gauge-board", study=study("run_1", "run_2")), 422, "runs[0].result: is run_1: give the identifier of the job")
    refused(ask(kind="gauge-board", study=study(NOBODY)), 422, "runs")
    refused(ask(kind="gauge-board", study=study(NOBODY, OTHER)), 404, f"study.runs[0].result: {NOBODY} is not in this project")
    refused(ask(kind="inspect-board", capture=f"cap_{'0' * 20}", regions=REGIONS), 422, "regions are given without golden")


BOARD = {"board": "9x6", "square_m": 0.03}


@pytest.mark.long
def test_a_board_calibrates_cameras_as_the_command_does(server, client, tmp_path):
    folder = write_board(tmp_path / "board", 4)
    identifier = sent(server, client, folder)
    job = finished(server, client, kind="calibrate-stereo", capture=identifier, options=BOARD)
    assert made_by(client, job) == {"calibration.json", f"{identifier}.capture.json"}
    stereo(StereoRequest(capture=folder, **BOARD))
    found = report_of(server, client, job, f"{identifier}.capture.json")
    wanted = json.loads((folder / "capture.json").read_text())
    assert found["frames"] == wanted["frames"] and found["camera"]["projection"] == "perspective"
    ours, theirs = (each["other_cameras"][0] for each in (found, wanted))
    # LAPACK adds in an order that depends on where arrays lie in memory, and four poses determine a lens poorly
    assert np.abs(np.array(ours["camera_from_other"]) - theirs["camera_from_other"]).max() < 1e-5
    assert np.abs(np.array(ours["focal_px"]) / theirs["focal_px"] - 1).max() < 1e-5
    report = report_of(server, client, job, "calibration.json")["stereo"]
    assert report["capture"] == report["options"]["capture"] == identifier
    assert found["other_cameras"][0]["depth_sigma"] == report["other_cameras"][0]["sigma"]["depth"] > 0
    refused(client.post("/v1/jobs", json={"kind": "calibrate-stereo", "capture": identifier, "options": {"board": "9x6"}}), 422, "")


@pytest.mark.long
def test_depth_of_two_cameras(server, client, tmp_path):
    parts, texture = [Wall((0, 0, -1.1), (0.2, 0.1, 1), 0.6)], [scenes.dots(7)]
    rng = np.random.default_rng(0)
    pair = [[scenes.recorded(scenes.render(parts, texture, *camera, side=2).images[0], rng)] for camera in ((), (scenes.OTHER, POSE))]
    identifier = sent(server, client, scenes.write_pair(tmp_path / "pair", *pair))
    job = finished(server, client, kind="depth", capture=identifier)
    assert {"depth.exr", "points.ply", "report.json"} <= made_by(client, job)
    report = report_of(server, client, job)
    assert report["method"] == "stereo" and report["pixels"]["ok"] > 0.8 * report["pixels"]["mask"]


@pytest.mark.long
def test_depth_beside_a_second_camera_under_one_projector(server, client, tmp_path):
    truth = two_captures(tmp_path)
    first, second = (sent(server, client, tmp_path / name) for name in ("first", "second"))
    job = finished(server, client, kind="depth", capture=first, beside=second)
    (tmp_path / "depth.exr").write_bytes(result(client, job, "depth.exr"))
    found = DepthMaps.read(tmp_path / "depth.exr")
    assert np.median(np.abs(found.depth - truth.depth)[found.mask]) < 1e-3  # metres, as of the command
    assert report_of(server, client, job)["found"]["beside"]["residual_px"]["median"] < 0.3
    refused(client.post("/v1/jobs", json={"kind": "depth", "capture": first, "beside": "cap_0123456789abcdefghjk"}), 404, "beside: ")
