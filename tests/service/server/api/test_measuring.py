"""Jobs that make no maps: bases, scans, patterns to project, and a rig that is driven."""

import io
import json
from pathlib import Path

import numpy as np
import pytest

from service.depth.patterns.projection import make_patterns
from service.requests.patterns import PatternsRequest
from stage.transforms import fibonacci_sphere
from tests.scenes.captures import files_in, make_scene, write_capture, write_exr
from tests.scenes.rigs import write_rig
from tests.service.server.api.job_calls import admitted, error_of, finished, made_by, refused, report_of, result
from tests.service.server.api.tus import Tus


def upload(server, client, files: dict[str, bytes], state: str = "ready") -> dict:
    """A capture of these files, checked; what is wrong with them names no folder of the server."""
    capture, tus = f"/v1/captures/{client.post('/v1/captures', json={'name': 'x'}).raise_for_status().json()['id']}", Tus(server.url)
    for name, content in files.items():
        tus.send(capture, name, content)
    client.post(f"{capture}/validate").raise_for_status()
    found = server.wait(client, capture, ("ready", "refused"))
    assert found["state"] == state and str(server.data) not in str(found["problem"]), found
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
    job = finished(server, client, kind="basis", capture=dome, options=options)
    assert made_by(client, job) == {file, f"{file}.json"}


@pytest.mark.long
def test_a_separation_and_a_scan(server, client, rig):
    job = finished(server, client, kind="separate", capture=rig, options={"period_px": 16})
    assert made_by(client, job) == {"separation.exr", "report.json"}
    assert report_of(server, client, job)["options"]["period_px"] == 16
    capture = upload(server, client, scan_files())
    assert capture["facts"]["shots"] == 90
    job = finished(server, client, kind="scan", capture=capture["id"], options={"near_m": 1})
    assert made_by(client, job) >= {"points.ply", "points.usdc", "report.json"}
    assert report_of(server, client, job)["shots"]["points"] == 90
    assert "capture.json" in error_of(server, client, kind="solve", capture=capture["id"])


@pytest.mark.long
def test_scans_that_cannot_be(server, client, registered):
    files = scan_files()
    cut = upload(server, client, files | {"shots.npy": files["shots.npy"][:-8]}, "refused")
    assert "shots.npy" in cut["problem"]
    away = upload(server, client, files | {"scan.json": files["scan.json"].replace(b"shots.npy", b"../x.npy")}, "refused")
    assert "leads out of the scan's folder" in away["problem"]
    folder = registered / "scan"
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    assert admitted(server, client, folder, "refused")["problem"] == "a scan is not registered: upload its folder"


def test_patterns_are_those_of_the_command(server, client, tmp_path):
    job = finished(server, client, kind="patterns", options={"code": "gray", "projector": [64, 40], "inverses": False})
    make_patterns(PatternsRequest(code="gray", projector=(64, 40), inverses=False, out=tmp_path))
    assert made_by(client, job) == {path.name for path in tmp_path.iterdir()}
    for path in tmp_path.glob("*.png"):
        assert result(client, job, path.name) == path.read_bytes()
    error = error_of(server, client, kind="patterns", options={"code": "gray", "projector": [64, 40], "micro_periods": 4})
    assert "micro_periods" in error.replace(" ", "_")


@pytest.mark.parametrize("request_", [{"kind": "patterns"}, {"kind": "patterns", "options": {"code": "gray", "projector": [0, 4]}},
                                      {"kind": "scan"}, {"kind": "basis", "options": {"basis": "jpeg"}}, {"kind": "calibrate"}])
def test_what_cannot_be_is_refused(client, request_):
    refused(client.post("/v1/jobs", json=request_), 422, "")


SUN = {"schema": "relit.keys/1", "lights": [
    {"name": "sun", "keys": [{"frame": 1, "direction": [0, 0, 1], "irradiance": [0.2, 0.2, 0.2]}]}]}


@pytest.fixture(scope="module")
def lamps(tmp_path_factory) -> dict:
    path = tmp_path_factory.mktemp("rig") / "dome.json"
    write_rig(path, fibonacci_sphere(24), irradiance=4.0, bits=16)
    return json.loads(path.read_text())


@pytest.mark.long
def test_a_job_writes_the_cues_that_the_command_line_writes(server, client, registered, lamps, relit, tmp_path):
    radiance = np.random.default_rng(3).uniform(0.1, 1, (16, 32, 3)).astype(np.float32)
    write_exr(registered / "noise.exr", radiance)
    sky = admitted(server, client, registered / "noise.exr", kind="environments")["id"]
    options = {"frames": "5-7", "spin_degrees": 90.0}
    job = finished(server, client, kind="drive", rig=lamps, environment=sky, options=options)
    assert made_by(client, job) == {"cues.csv", "cues.json", "preview.png", "report.json", "rig.json"}
    (tmp_path / "dome.json").write_text(json.dumps(lamps))
    relit.done("drive", tmp_path / "dome.json", "--environment", registered / "noise.exr", "--frames", "5-7", "--spin-degrees", "90",
               "--out", tmp_path / "cues", "--device", "cpu")
    for name in ("cues.csv", "cues.json", "preview.png"):
        assert result(client, job, name) == (tmp_path / "cues" / name).read_bytes()
    assert report_of(server, client, job, "rig.json") == lamps
    assert report_of(server, client, job)["inputs"]["rig"]["path"] == f"{job['id']}/rig.json"
    error = error_of(server, client, kind="drive", rig=lamps, environment=sky, options={"exposure": 12.0})
    assert "is beyond all limits of the rig dome" in error and str(registered) not in error


@pytest.mark.long
def test_a_chart_and_a_capture_come_with_a_job(server, client, relit, tmp_path):
    """A chart whose camera sees a quarter of the red that the irradiances say; the capture is the first sample of the service."""
    rig = write_rig(tmp_path / "dome.json", fibonacci_sphere(24), irradiance=4.0, bits=16)
    patches = [[0.9, 0.9, 0.9], [0.4, 0.1, 0.1], [0.1, 0.3, 0.2], [0.1, 0.1, 0.4]]
    chart = {"schema": "relit.chart/1", "target": patches, "primaries": {name: [
        [4 * part * (c == k) for c, part in enumerate(patch)] for patch in patches] for k, name in enumerate(("red", "green", "blue"))}}
    chart["primaries"]["red"] = [[part / 4 for part in patch] for patch in chart["primaries"]["red"]]
    (tmp_path / "chart.json").write_text(json.dumps(chart))
    (tmp_path / "sun.json").write_text(json.dumps(SUN))
    scene = write_capture(tmp_path / "object", make_scene(16, 6))
    job = finished(server, client, kind="drive", rig=rig, keys=SUN, chart=chart, capture=upload(server, client, files_of(scene))["id"])
    assert {"chart.json", "predicted.0001.exr"} <= made_by(client, job)
    relit.done("drive", tmp_path / "dome.json", "--keys", tmp_path / "sun.json", "--chart", tmp_path / "chart.json", "--capture", scene,
               "--out", tmp_path / "cues", "--device", "cpu")
    for name in ("cues.csv", "predicted.0001.exr"):
        assert result(client, job, name) == (tmp_path / "cues" / name).read_bytes()
    red = [row for row in (tmp_path / "cues" / "cues.csv").read_text().splitlines() if ",red," in row]
    assert sum(float(row.rpartition(",")[2]) for row in red) == pytest.approx(4 * 0.05, abs=1e-3)


@pytest.mark.long
def test_light_keys_drive_a_rig_alone_and_lie_beside_its_cues(server, client, lamps):
    job = finished(server, client, kind="drive", rig=lamps, keys=SUN)
    assert "keys.json" in made_by(client, job)
    frame, = report_of(server, client, job, "cues.json")["frames"]
    assert sum(frame["levels"]) == pytest.approx(3 * 0.05, abs=1e-3)  # .2 of 4; each level is off by half a step at most


def test_what_cannot_be_driven_is_refused_by_name(client, lamps, relit, tmp_path):
    def ask(**request):
        return client.post("/v1/jobs", json={"kind": "drive", **request})

    first, *others = lamps["lights"]
    for wrong, words in (
            ({"lights": [first | {"least": 2}, *others]}, "lights[0].least: "),
            ({"lights": [first, first]}, "lights[1].name: L000 is already the name of lights[0]"),
            ({"lamps": []}, "lamps: "),
            ({"name": ""}, "name: ")):
        response = ask(rig={**lamps, **wrong}, keys=SUN)
        refused(response, 422, words)
        assert response.json()["errors"][0]["field"] == "body.drive.rig"
    (tmp_path / "wrong.json").write_text(json.dumps({**lamps, "lights": [first | {"least": 2}]}))
    (tmp_path / "sun.json").write_text(json.dumps(SUN))
    sentence = relit.refused("submit", "drive", tmp_path / "wrong.json", "--keys", tmp_path / "sun.json")  # before a server is asked
    assert "wrong.json: lights[0].least: " in sentence
    refused(ask(rig={**lamps, "schema": "relit.rig/2"}, keys=SUN), 422, "relit.rig/1")
    refused(ask(keys=SUN), 422, "is missing")
    refused(ask(rig=lamps), 422, "nothing lights the frames")
    refused(ask(rig=lamps, environment=f"env_{'0' * 20}"), 404, "environment: ")
    refused(ask(rig=lamps, keys=SUN, options={"frames": "1-20001"}), 422, "20000 are allowed in a job")
    captured = {"schema": "relit.keys/1", "captured": [{"image": "0.exr", "keys": [{"frame": 1, "weight": 1}]}]}
    refused(ask(rig=lamps, keys=captured), 422, "has captured images, which lamps cannot show")
