"""Captures of several cameras as jobs: calibration from a board, and depth from texture."""

import json

import numpy as np
import pytest

from service.calibrate.stereo import stereo
from service.requests.calibrate import StereoRequest
from stage.results.depth_maps import DepthMaps
from tests.scenes import stereo as scenes
from tests.scenes.stereo import OTHER, POSE, Plane
from tests.service.calibrate.test_calibrate_stereo import write_board
from tests.service.depth.stereo.test_two_cameras import two_captures
from tests.service.server.api.job_calls import finish, made_by, refused, submit
from tests.service.server.api.test_calibrating import sent

BOARD = {"board": "9x6", "square_m": 0.03}


@pytest.mark.long
def test_a_board_calibrates_cameras_as_the_command_does(server, client, tmp_path):
    folder = write_board(tmp_path / "board", 4)
    identifier = sent(server, client, folder)
    job = submit(client, kind="calibrate-stereo", capture=identifier, options=BOARD)
    finish(server, client, job)
    assert made_by(client, job) == {"calibration.json", f"{identifier}.capture.json"}
    stereo(StereoRequest(capture=folder, **BOARD))
    found = client.get(f"/v1/jobs/{job['id']}/results/{identifier}.capture.json").json()
    wanted = json.loads((folder / "capture.json").read_text())
    assert found["frames"] == wanted["frames"] and found["camera"]["projection"] == "perspective"
    ours, theirs = (each["other_cameras"][0] for each in (found, wanted))
    # LAPACK adds in an order that depends on where arrays lie in memory, and four poses determine a lens poorly
    assert np.abs(np.array(ours["camera_from_other"]) - theirs["camera_from_other"]).max() < 1e-5
    assert np.abs(np.array(ours["focal_px"]) / theirs["focal_px"] - 1).max() < 1e-5
    report = client.get(f"/v1/jobs/{job['id']}/results/calibration.json").json()["stereo"]
    assert report["capture"] == report["options"]["capture"] == identifier and str(server.data) not in json.dumps(report)
    refused(client.post("/v1/jobs", json={"kind": "calibrate-stereo", "capture": identifier, "options": {"board": "9x6"}}), 422, "")


@pytest.mark.long
def test_depth_of_two_cameras(server, client, tmp_path):
    parts, texture = [Plane((0, 0, -1.1), (0.2, 0.1, 1))], [scenes.dots(7)]
    rng = np.random.default_rng(0)
    pair = [[scenes.recorded(scenes.render(parts, texture, *camera, side=2).images[0], rng)] for camera in ((), (OTHER, POSE))]
    identifier = sent(server, client, scenes.write_pair(tmp_path / "pair", *pair))
    job = submit(client, kind="depth", capture=identifier)
    finish(server, client, job)
    assert {"depth.exr", "points.ply", "report.json"} <= made_by(client, job)
    report = client.get(f"/v1/jobs/{job['id']}/results/report.json").json()
    assert report["method"] == "stereo" and report["pixels"]["ok"] > 0.8 * report["pixels"]["mask"]


@pytest.mark.long
def test_depth_beside_a_second_camera_under_one_projector(server, client, tmp_path):
    truth = two_captures(tmp_path)
    first, second = (sent(server, client, tmp_path / name) for name in ("first", "second"))
    job = submit(client, kind="depth", capture=first, beside=second)
    finish(server, client, job)
    (tmp_path / "depth.exr").write_bytes(client.get(f"/v1/jobs/{job['id']}/results/depth.exr").raise_for_status().content)
    found = DepthMaps.read(tmp_path / "depth.exr")
    assert np.median(np.abs(found.depth - truth.depth)[found.mask]) < 1e-3  # metres, as of the command
    report = client.get(f"/v1/jobs/{job['id']}/results/report.json").json()
    assert report["found"]["beside"]["residual_px"]["median"] < 0.3 and str(server.data) not in json.dumps(report)
    refused(client.post("/v1/jobs", json={"kind": "depth", "capture": first, "beside": "cap_0123456789abcdefghjk"}), 404, "beside: ")
