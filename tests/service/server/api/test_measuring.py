"""Jobs that make no maps: bases, scans and patterns to project."""

import io
import json
from pathlib import Path

import numpy as np
import pytest

from service.depth.patterns.projection import make_patterns
from service.requests.patterns import PatternsRequest
from tests.scenes.captures import files_in
from tests.service.server.api.job_calls import admitted, finish, made_by, refused, submit
from tests.service.server.api.tus import Tus


def upload(server, client, files: dict[str, bytes], state: str = "ready") -> dict:
    """A capture of these files, checked."""
    capture, tus = f"/v1/captures/{client.post('/v1/captures', json={'name': 'x'}).raise_for_status().json()['id']}", Tus(server.url)
    for name, content in files.items():
        tus.send(capture, name, content)
    client.post(f"{capture}/validate").raise_for_status()
    found = server.wait(client, capture, ("ready", "refused"))
    assert found["state"] == state, found
    return found


def files_of(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in sorted(files_in(folder))}


def scan_files(shots: int = 90) -> dict[str, bytes]:
    azimuth = np.linspace(-np.pi, np.pi, shots, endpoint=False)
    file = io.BytesIO()
    np.save(file, np.stack([np.linspace(0, 1, shots), azimuth, np.zeros(shots), np.full(shots, 5.0), np.ones(shots)], axis=1))
    return {"scan.json": json.dumps({"schema": "relit.scan/1", "name": "yard", "shots": "shots.npy"}).encode(),
            "shots.npy": file.getvalue()}


@pytest.mark.long
@pytest.mark.parametrize(("options", "file"), [({}, "basis.exr"), ({"basis": "hsh", "count": 4}, "basis.rti")])
def test_a_basis(server, client, dome, options, file):
    job = submit(client, kind="basis", capture=dome, options=options)
    finish(server, client, job)
    assert made_by(client, job) == {file, f"{file}.json"}


@pytest.mark.long
def test_a_separation_and_a_scan(server, client, rig):
    job = submit(client, kind="separate", capture=rig, options={"period_px": 16})
    finish(server, client, job)
    assert made_by(client, job) == {"separation.exr", "report.json"}
    report = client.get(f"/v1/jobs/{job['id']}/results/report.json").json()
    assert report["options"]["period_px"] == 16 and str(server.data) not in json.dumps(report)
    capture = upload(server, client, scan_files())
    assert capture["facts"]["shots"] == 90
    job = submit(client, kind="scan", capture=capture["id"], options={"near_m": 1})
    finish(server, client, job)
    assert made_by(client, job) >= {"points.ply", "points.usdc", "report.json"}
    assert client.get(f"/v1/jobs/{job['id']}/results/report.json").json()["shots"]["points"] == 90
    solve = submit(client, kind="solve", capture=capture["id"])
    assert "capture.json" in finish(server, client, solve, "failed")["error"]


@pytest.mark.long
def test_scans_that_cannot_be(server, client, registered):
    files = scan_files()
    cut = upload(server, client, files | {"shots.npy": files["shots.npy"][:-8]}, "refused")
    assert "shots.npy" in cut["problem"] and str(server.data) not in cut["problem"]
    away = upload(server, client, files | {"scan.json": files["scan.json"].replace(b"shots.npy", b"../x.npy")}, "refused")
    assert "leads out of the scan's folder" in away["problem"]
    folder = registered / "scan"
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    assert admitted(server, client, folder, "refused")["problem"] == "a scan is not registered: upload its folder"


def test_patterns_are_those_of_the_command(server, client, tmp_path):
    job = submit(client, kind="patterns", options={"code": "gray", "projector": [64, 40], "inverses": False})
    finish(server, client, job)
    make_patterns(PatternsRequest(code="gray", projector=(64, 40), inverses=False, out=tmp_path))
    assert made_by(client, job) == {path.name for path in tmp_path.iterdir()}
    for path in tmp_path.glob("*.png"):
        assert client.get(f"/v1/jobs/{job['id']}/results/{path.name}").content == path.read_bytes()
    other = submit(client, kind="patterns", options={"code": "gray", "projector": [64, 40], "micro_periods": 4})
    assert "micro_periods" in finish(server, client, other, "failed")["error"].replace(" ", "_")


@pytest.mark.parametrize("request_", [{"kind": "patterns"}, {"kind": "patterns", "options": {"code": "gray", "projector": [0, 4]}},
                                      {"kind": "scan"}, {"kind": "basis", "options": {"basis": "jpeg"}}, {"kind": "calibrate"}])
def test_what_cannot_be_is_refused(client, request_):
    refused(client.post("/v1/jobs", json=request_), 422, "")
