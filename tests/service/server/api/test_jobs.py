"""Jobs through the API of a real server: every kind, every refusal, and what becomes of those that are cancelled or fail."""

import json
import re
import time
import zlib

import httpx2
import pytest

from service.requests.identifiers import new_id
from service.server.database.engine import storable
from tests.service.server_process import Server

ENDED = ("succeeded", "failed", "cancelled")
WAIT_S = 120.0
NOBODY = new_id("job")


def submit(client: httpx2.Client, **request) -> dict:
    response = client.post("/v1/jobs", json=request)
    assert response.status_code == 202, response.text
    assert response.headers["Location"] == f"/v1/jobs/{response.json()['id']}"
    return response.json()


def finish(server: Server, client: httpx2.Client, job: dict, state: str = "succeeded") -> dict:
    done = server.wait(client, f"/v1/jobs/{job['id']}", ENDED)
    assert done["state"] == state, done
    return done


def made_by(client: httpx2.Client, job: dict) -> set[str]:
    return {file["name"] for file in client.get(f"/v1/jobs/{job['id']}/results").raise_for_status().json()["results"]}


def refused(response: httpx2.Response, status: int, words: str) -> None:
    assert response.status_code == status, response.text
    assert response.headers["Content-Type"] == "application/problem+json"
    assert words in response.json()["detail"], response.json()["detail"]


@pytest.fixture(scope="module")
def solved(server, client, dome) -> str:
    job = submit(client, kind="solve", capture=dome, options={"method": "lambert"})
    return finish(server, client, job)["id"]


@pytest.fixture(scope="module")
def long(client, dome, sky):
    """A request for more frames than any test waits for."""
    return {"kind": "relight", "capture": dome, "environment": sky, "options": {"frames": "1-20000", "spin_degrees": 360}}


def has_made(client: httpx2.Client, job: dict, count: int) -> None:
    """Wait until a job has made some frames."""
    deadline = time.monotonic() + WAIT_S
    while len(made_by(client, job)) < count:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_pipeline_solves_exports_and_relights(server, client, dome, sky):
    job = submit(client, kind="pipeline", capture=dome, environment=sky, solve={"method": "lambert"},
                 relight={"frames": "1-3", "spin_degrees": 360})
    assert (job["state"], job["attempt"], job["progress"], job["started_at"], job["error"]) == ("queued", 1, None, None, None)
    done = finish(server, client, job)
    assert done["error"] is None and done["progress"] | {"rate": None, "remaining_s": None} == {
        "stage": "frames", "done": 3, "total": 3, "rate": None, "remaining_s": None}
    assert done["created_at"] <= done["started_at"] <= done["finished_at"]
    assert made_by(client, job) == {"maps.exr", "report.json", "asset.usdz", "frame.0001.exr", "frame.0002.exr", "frame.0003.exr"}


def test_a_solve(server, client, dome, solved):
    job = client.get(f"/v1/jobs/{solved}").json()
    assert job["request"]["options"] == {"align": False, "align_to": None, "crop": None, "clip_negative": False, "method": "lambert",
                                         "lights": "declared", "intensities": "chosen", "max_sigma": None, "least_confidence": None}
    assert made_by(client, job) == {"maps.exr", "report.json"}
    report = client.get(f"/v1/jobs/{solved}/results/report.json").raise_for_status().json()
    assert report["method"] == "lambert"


def test_an_export_brings_lights_along(server, client, dome, sky, solved):
    exported = submit(client, kind="export", maps=solved, format="usdz", rig=dome, environment=sky)
    finish(server, client, exported)
    lights = {"asset_lights/rig.usda", "asset_lights/environment.usda", "asset_lights/environment.exr"}
    assert made_by(client, exported) == {"asset.usdz", *lights}
    rig = client.get(f"/v1/jobs/{exported['id']}/results/asset_lights/rig.usda").raise_for_status()
    assert rig.content.count(b"def DistantLight") >= 4


def test_a_depth(server, client, rig):
    job = submit(client, kind="depth", capture=rig, options={"normals": True, "max_residual_px": 2.5}, name="the rig")
    assert (job["request"]["name"], job["request"]["options"]["max_residual_px"]) == ("the rig", 2.5)
    finish(server, client, job)
    assert made_by(client, job) == {"depth.exr", "points.ply", "report.json"}
    exported = submit(client, kind="export", maps=job["id"], format="usdc", options={"geometry": "points"})
    finish(server, client, exported)
    layers = {f"asset_layers/{name}" for name in ("payload.usda", "geometry.usdc", "materials.usda")}
    assert made_by(client, exported) == {"asset.usdc", *layers, "asset_textures/base_color.png"}


def test_a_relight_guided_by_maps_and_lit_by_keys(server, client, dome, solved):
    keys = {"schema": "relit.keys/1", "lights": [{"name": "sun", "keys": [
        {"frame": 3, "direction": [0, 0, 1], "irradiance": [1, 1, 1]}, {"frame": 5, "direction": [0.5, 0, 1], "irradiance": [2, 1, 1]}]}]}
    job = submit(client, kind="relight", capture=dome, keys=keys, maps=solved, options={"frames": "3-5", "exposure": 1, "aov": ["beauty"]})
    finish(server, client, job)
    assert made_by(client, job) == {"keys.json", "frame.0003.exr", "frame.0004.exr", "frame.0005.exr"}


def test_a_shade_under_near_lights(server, client, solved, sky):
    lamp = {"position_m": [0, 0, 300], "intensity": [1e5, 1e5, 1e5]}
    for light in (lamp, "0,0,300,1e5,1e5,1e5"):
        job = submit(client, kind="shade", maps=solved, environment=sky, options={"light": [light], "turn_degrees": 90})
        finish(server, client, job)
        assert made_by(client, job) == {"picture.exr"}


def test_a_view_of_maps_of_a_depth_and_of_a_capture_alone(server, client, dome, solved, rig):
    depth = submit(client, kind="depth", capture=rig)
    finish(server, client, depth)
    shown = {}
    for name, request in {"maps": {"capture": dome, "maps": solved, "options": {"terms": 4}},
                          "depth": {"capture": rig, "maps": depth["id"]}, "capture": {"capture": dome}}.items():
        job = submit(client, kind="view", **request)
        finish(server, client, job)
        assert made_by(client, job) == {"view.json", "view.bin", "thumbnails.jpg"}
        results = f"/v1/jobs/{job['id']}/results"
        shown[name] = client.get(f"{results}/view.json").raise_for_status().json()
        for offset, length in [place for layer in shown[name]["layers"] for place in layer["levels"][0]["tiles"]]:
            tile = client.get(f"{results}/view.bin", headers={"Range": f"bytes={offset}-{offset + length - 1}"})
            assert tile.status_code == 206 and len(zlib.decompress(tile.content)) > 0
    assert [layer["name"] for layer in shown["maps"]["layers"]][:2] == ["normal", "diffuse_albedo"]
    assert shown["maps"]["relight"]["terms"] <= 4 and shown["capture"]["layers"] == []
    assert shown["depth"]["layers"][0]["name"] == "depth" and shown["depth"]["relight"] is None


def test_an_export(server, client, solved):
    job = submit(client, kind="export", maps=solved, format="usda", options={"name": "dome"})
    finish(server, client, job)
    usda = client.get(f"/v1/jobs/{job['id']}/results/asset.usda").raise_for_status().text
    assert usda.startswith("#usda") and "dome" in usda and "@./asset_layers/payload.usda@" in usda
    assert {"asset.usda", *(f"asset_layers/{name}" for name in ("payload.usda", "materials.usda", "geometry.usdc"))} <= made_by(client, job)


def test_an_export_as_gltf(server, client, solved):
    job = submit(client, kind="export", maps=solved, format="glb")
    finish(server, client, job)
    glb = client.get(f"/v1/jobs/{job['id']}/results/asset.glb").raise_for_status()
    assert glb.content[:4] == b"glTF" and glb.headers["Content-Type"] == "model/gltf-binary"


def test_what_a_job_reads_has_to_be_there_and_ready(server, client, dome, sky, solved, rig):
    receiving = client.post("/v1/captures", json={"name": "to come"}).raise_for_status().json()["id"]
    waiting = submit(client, kind="depth", capture=rig)
    finish(server, client, waiting)
    nowhere, nothing = new_id("cap"), new_id("env")

    def ask(**request) -> httpx2.Response:
        return client.post("/v1/jobs", json=request)

    refused(ask(kind="solve", capture=nowhere), 404, f"capture: {nowhere} is not in this project")
    refused(ask(kind="solve", capture=dome, reference_ball=nowhere), 404, f"reference_ball: {nowhere} is not in this project")
    refused(ask(kind="relight", capture=dome, environment=nothing), 404, f"environment: {nothing} is not in this project")
    refused(ask(kind="export", maps=NOBODY), 404, f"maps: {NOBODY} is not in this project")
    refused(ask(kind="solve", capture=receiving), 409, f"capture: {receiving} is receiving, not ready")
    refused(ask(kind="shade", maps=waiting["id"]), 422, f"maps: {waiting['id']} is a depth job: give one of solve, pipeline")
    refused(ask(kind="relight", capture=dome), 422, "nothing lights the frames")
    refused(ask(kind="relight", capture=dome, environment=sky, options={"frames": "9-1"}), 422, "runs backwards: give 1-9")
    refused(ask(kind="relight", capture=dome, environment=sky, options={"frames": "1-20001"}), 422, "20000 are allowed in a job")


@pytest.mark.parametrize("body, field, message", [
    ({"kind": "check", "intake": "x"}, "body", "does not match any of the expected tags"),
    ({"capture": "x"}, "body", "Unable to extract tag"),
    ({"kind": "solve"}, "body.solve.capture", "Field required"),
    ({"kind": "solve", "capture": "../owl"}, "body.solve.capture", "String should match pattern"),
    ({"kind": "solve", "capture": new_id("cap"), "out": "/etc"}, "body.solve.out", "Extra inputs are not permitted"),
    ({"kind": "solve", "capture": new_id("cap"), "options": {"device": "cuda:0"}}, "body.solve.options.device", "Extra inputs"),
    ({"kind": "solve", "capture": new_id("cap"), "options": {"method": "magic"}}, "body.solve.options.method", "Input should be"),
    ({"kind": "solve", "capture": new_id("cap"), "options": {"align": "yes"}}, "body.solve.options.align", "valid boolean"),
    ({"kind": "solve", "capture": new_id("cap"), "priority": "5"}, "body.solve.priority", "valid integer"),
    ({"kind": "solve", "capture": new_id("cap"), "priority": 2**70}, "body.solve.priority", "less than or equal to 100"),
    ({"kind": "solve", "capture": new_id("cap"), "name": "a\0b"}, "body.solve.name", "String should match pattern"),
    ({"kind": "depth", "capture": new_id("cap"), "options": {"tof": {"calibration": "/etc/passwd"}}},
     "body.depth.options.tof.calibration", "Extra inputs"),
    ({"kind": "shade", "maps": NOBODY, "options": {"light": [{"position_m": [0, 0, "1"], "intensity": [1, 1, 1]}]}},
     "body.shade.options.light.0.position_m.2", "valid number"),
], ids=lambda value: value if isinstance(value, str) else "")
def test_a_request_that_cannot_be_is_refused_by_name(client, body, field, message):
    response = client.post("/v1/jobs", json=body)
    refused(response, 422, message)
    fault, = response.json()["errors"]
    assert fault["field"] == field and message in fault["message"]
    assert re.fullmatch(r"[0-9a-f]{16}", response.json()["request_id"])
    assert response.headers["X-Request-Id"] == response.json()["request_id"]


@pytest.mark.parametrize("text", [
    '{"kind": "solve"', "\x00", '{"kind": "\\ud800"}', '{"kind": "solve", "capture": "cap_00000000000000000000", "\\ud800": 1}',
    '{"kind": "relight", "capture": "cap_00000000000000000000", "options": {"exposure": NaN}}',
    '{"kind": "relight", "capture": "cap_00000000000000000000", "options": {"spin_degrees": 1e999}}',
    '{"kind": "solve", "capture": "cap_00000000000000000000", "priority": ' + "9" * 5000 + "}", "[" * 100_000, b'{"kind": "\xff"}',
], ids=["cut", "nul", "surrogate", "surrogate key", "nan", "infinity", "integer", "deep", "no utf-8"])
def test_a_body_that_is_no_proper_json_is_refused(client, text):
    response = client.post("/v1/jobs", content=text, headers={"Content-Type": "application/json"})
    assert response.status_code in (400, 422), response.text
    assert response.json()["detail"]


def test_values_at_the_edge_of_what_numbers_hold_are_kept(client, dome):
    largest, smallest = 1.7e308, 5e-324
    keys = {"schema": "relit.keys/1", "lights": [{"name": "sun", "keys": [
        {"frame": 999_999_999, "direction": [largest, largest, largest], "irradiance": [largest, 0, smallest]}]}],
        "environment": [{"frame": 1, "axis": [0, smallest, 0], "turn_degrees": -largest}]}
    job = submit(client, kind="relight", capture=dome, keys=keys, options={"frames": "1"}, priority=0)
    client.post(f"/v1/jobs/{job['id']}/cancel")
    track, = client.get(f"/v1/jobs/{job['id']}").json()["request"]["keys"]["lights"]
    assert track["keys"][0]["direction"] == pytest.approx([3**-0.5] * 3) and track["keys"][0]["irradiance"] == [largest, 0, smallest]
    keys["lights"][0]["keys"][0]["frame"] += 1
    refused(client.post("/v1/jobs", json={"kind": "relight", "capture": dome, "keys": keys}), 422, "less than or equal to 999999999")


def test_a_sentence_that_repeats_what_is_no_text_can_be_kept():
    assert storable("there is no a\0b\udcff.exr") == "there is no a\ufffdb?.exr"


def test_bodies_are_json_and_no_larger_than_json_has_to_be(client):
    good = json.dumps({"kind": "solve", "capture": new_id("cap")})
    assert client.post("/v1/jobs", content=good, headers={"Content-Type": "application/json; charset=utf-8"}).status_code == 404
    refused(client.post("/v1/jobs", content=good, headers={"Content-Type": "text/plain"}), 415, "send Content-Type: application/json")
    refused(client.post("/v1/jobs", content=good), 415, "send Content-Type: application/json")
    large = " " * (1 << 20) + good
    refused(client.post("/v1/jobs", content=large, headers={"Content-Type": "application/json"}), 413, "larger than 1048576 bytes")
    pieces = (large[at : at + 65536].encode() for at in range(0, len(large), 65536))  # sent without a length
    refused(client.post("/v1/jobs", content=pieces, headers={"Content-Type": "application/json"}), 413, "larger than 1048576 bytes")


def test_a_job_that_fails_says_why_and_is_tried_again(server, client, dome):
    job = submit(client, kind="depth", capture=dome)  # has lights, and no patterns
    failed = finish(server, client, job, "failed")
    assert "none has a pattern with a code, a laser, tof or stereo" in failed["error"] and "\n" not in failed["error"]
    refused(client.post(f"/v1/jobs/{job['id']}/resume"), 409, "is failed, not cancelled")
    refused(client.post(f"/v1/jobs/{job['id']}/cancel"), 409, "is failed: it has ended")
    again = client.post(f"/v1/jobs/{job['id']}/retry")
    assert again.status_code == 202
    assert again.json()["attempt"] == 2 and again.json()["error"] is None and again.json()["state"] in ("queued", "running")
    assert finish(server, client, job, "failed")["error"] == failed["error"]


def test_a_job_that_runs_is_cancelled_and_the_next_begins(server, client, long, dome):
    job = submit(client, **long)
    has_made(client, job, 5)
    assert client.delete(f"/v1/jobs/{job['id']}").status_code == 409
    cancelled = client.post(f"/v1/jobs/{job['id']}/cancel")
    assert (cancelled.status_code, cancelled.json()["state"]) == (202, "cancelled")
    finish(server, client, submit(client, kind="solve", capture=dome, options={"method": "lambert"}))
    frames = made_by(client, job)
    assert 5 <= len(frames) < 20000
    finish(server, client, submit(client, kind="solve", capture=dome, options={"method": "lambert"}))
    assert made_by(client, job) == frames  # nobody works on it any more
    assert client.get(f"/v1/jobs/{job['id']}").json() == cancelled.json()
    assert client.delete(f"/v1/jobs/{job['id']}").status_code == 204
    assert client.get(f"/v1/jobs/{job['id']}").status_code == 404
    assert not (server.data / "projects/default/jobs" / job["id"]).exists()


def test_a_cancelled_job_goes_on_with_what_is_done(server, client, dome, sky):
    request = {"kind": "relight", "capture": dome, "environment": sky, "options": {"frames": "1-150", "spin_degrees": 360}}
    job = submit(client, **request)
    has_made(client, job, 10)
    client.post(f"/v1/jobs/{job['id']}/cancel").raise_for_status()
    finish(server, client, submit(client, kind="solve", capture=dome, options={"method": "lambert"}))  # the worker is at the next job now
    folder = server.data / "projects/default/jobs" / job["id"]
    done = {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.glob("frame.*.exr")}
    assert 10 <= len(done) < 150
    refused(client.post(f"/v1/jobs/{job['id']}/retry"), 409, "is cancelled, not failed")
    assert client.post(f"/v1/jobs/{job['id']}/resume").json()["attempt"] == 2
    finished = finish(server, client, job)
    assert (finished["progress"]["done"], finished["attempt"]) == (150, 2)
    assert {name: ((folder / name).stat().st_ino, (folder / name).stat().st_mtime_ns) for name in done} == done
    undisturbed = server.data / "projects/default/jobs" / finish(server, client, submit(client, **request))["id"]
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {path.name: path.read_bytes() for path in undisturbed.iterdir()}


def test_the_highest_priority_goes_first(server, client, long, dome):
    before = submit(client, **long, priority=100)
    has_made(client, before, 1)  # the worker is busy

    def wait(priority: int) -> dict:
        return submit(client, kind="solve", capture=dome, options={"method": "lambert"}, priority=priority)

    low, high, raised, equal, dropped = wait(10), wait(90), wait(5), wait(10), wait(100)
    changed = client.patch(f"/v1/jobs/{raised['id']}", json={"priority": 95})
    assert (changed.status_code, changed.json()["priority"], changed.json()["state"]) == (200, 95, "queued")
    refused(client.patch(f"/v1/jobs/{before['id']}", json={"priority": 1}), 409, "only a queued job has a priority to change")
    refused(client.patch(f"/v1/jobs/{low['id']}", json={"priority": 101}), 422, "less than or equal to 100")
    refused(client.patch(f"/v1/jobs/{low['id']}", json={}), 422, "Field required")
    client.post(f"/v1/jobs/{dropped['id']}/cancel").raise_for_status()
    client.post(f"/v1/jobs/{before['id']}/cancel").raise_for_status()
    began = {name: finish(server, client, job)["started_at"] for name, job in
             {"low": low, "high": high, "raised": raised, "equal": equal}.items()}
    assert sorted(began, key=began.get) == ["raised", "high", "low", "equal"]
    assert client.get(f"/v1/jobs/{dropped['id']}").json()["started_at"] is None
    refused(client.patch(f"/v1/jobs/{raised['id']}", json={"priority": 1}), 409, "is succeeded")


def test_jobs_are_listed_a_page_at_a_time_the_newest_first(client, solved):
    whole = client.get("/v1/jobs", params={"limit": 500}).raise_for_status().json()
    assert whole["next"] is None and len(whole["jobs"]) > 5
    created = [job["created_at"] for job in whole["jobs"]]
    assert created == sorted(created, reverse=True)
    pages, before = [], {}
    while before is not None:
        page = client.get("/v1/jobs", params={"limit": 3, **before}).raise_for_status().json()
        assert 0 < len(page["jobs"]) <= 3
        pages += [job["id"] for job in page["jobs"]]
        before = None if page["next"] is None else {"before": page["next"]}
    assert pages == [job["id"] for job in whole["jobs"]]
    for states in (["succeeded"], ["failed", "cancelled"]):
        found = client.get("/v1/jobs", params={"limit": 500, "state": states}).raise_for_status().json()["jobs"]
        assert [job["id"] for job in found] == [job["id"] for job in whole["jobs"] if job["state"] in states]
    refused(client.get("/v1/jobs", params={"before": NOBODY}), 404, f"{NOBODY} is not in this project")
    refused(client.get("/v1/jobs", params={"limit": 0}), 422, "query.limit")
    refused(client.get("/v1/jobs", params={"state": "lost"}), 422, "query.state.0")


@pytest.mark.parametrize("method, path", [
    ("GET", ""), ("GET", "/results"), ("GET", "/results/maps.exr"), ("GET", "/events"), ("POST", "/cancel"), ("POST", "/retry"),
    ("POST", "/resume"), ("DELETE", "")])
def test_a_job_that_is_not_there(client, method, path):
    refused(client.request(method, f"/v1/jobs/{NOBODY}{path}"), 404, NOBODY)
    refused(client.request(method, f"/v1/jobs/job_1{path}"), 422, "path.job")


def test_what_a_job_reads_stays_until_it_has_ended(server, client, long, solved):
    job = submit(client, kind="export", maps=solved, priority=0)
    if client.delete(f"/v1/jobs/{solved}").status_code == 204:
        pytest.fail("maps of a job that waits were deleted")
    finish(server, client, job)


def test_a_job_that_is_cancelled_and_deleted_while_it_runs_is_no_error_in_the_log(server, client, dome, sky):
    """DBOS wrote a traceback, since the workflow that it ends is not there any more."""
    job = submit(client, kind="relight", capture=dome, environment=sky, options={"frames": "1-5000"})["id"]
    server.wait(client, f"/v1/jobs/{job}", ("running",))
    client.post(f"/v1/jobs/{job}/cancel").raise_for_status()
    assert client.delete(f"/v1/jobs/{job}").status_code == 204
    finish(server, client, submit(client, kind="solve", capture=dome))
    lines = [json.loads(line) for line in server.log.read_text().splitlines()]
    assert any(line["event"] == "step stopped" and line["job"] == job for line in lines)
    assert [line for line in lines if line["level"] == "error" and line.get("logger") == "dbos"] == []


def texts(client: httpx2.Client, job: dict) -> list[str]:
    entries = client.get(f"/v1/jobs/{job['id']}/log").raise_for_status().json()["entries"]
    assert [entry["at"] for entry in entries] == sorted(entry["at"] for entry in entries)
    return [f"{entry['attempt']} {entry['text']}" for entry in entries]


def test_the_log_says_what_happened(server, client, dome, long):
    solved = finish(server, client, submit(client, kind="solve", capture=dome, options={"method": "lambert"}))
    found = texts(client, solved)
    assert found[0] == "1 begun by a worker" and found[-1] == "1 succeeded"
    assert any(each.startswith("1 ingest, ") for each in found) and any(each.startswith("1 normals, ") for each in found)
    job = submit(client, **long)
    has_made(client, job, 1)
    client.post(f"/v1/jobs/{job['id']}/cancel").raise_for_status()
    client.post(f"/v1/jobs/{job['id']}/resume").raise_for_status()
    client.post(f"/v1/jobs/{job['id']}/cancel").raise_for_status()
    found = texts(client, job)
    assert found.index("1 cancelled") < found.index("2 queued again") < found.index("2 cancelled")
    failing = finish(server, client, submit(client, kind="solve", capture=dome, options={"align_to": "nothing.png"}), "failed")
    assert texts(client, failing)[-1] == f"1 failed: {failing['error']}"


def test_the_log_goes_with_its_job(server, client, dome):
    job = finish(server, client, submit(client, kind="solve", capture=dome, options={"method": "lambert"}))
    client.delete(f"/v1/jobs/{job['id']}").raise_for_status()
    refused(client.get(f"/v1/jobs/{job['id']}/log"), 404, "there is no")
    refused(client.get(f"/v1/jobs/{NOBODY}/log"), 404, "there is no")
