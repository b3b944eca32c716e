"""Jobs through the API of a real server: every kind, how they are listed, and requests that are refused."""

import re
import zlib

import httpx2
import pytest

from service.requests.base.identifiers import new_id
from service.requests.jobs import JOBS, SolveJob
from service.server.database.engine import storable
from tests.service.server.api.job_calls import NOBODY, finish, finished, made_by, refused, report_of, result, submit, succeeded


@pytest.mark.long
def test_a_pipeline_solves_exports_and_relights(server, client, dome, sky):
    job = submit(client, kind="pipeline", capture=dome, environment=sky, solve={"method": "lambert"},
                 relight={"frames": "1-3", "spin_degrees": 360})
    assert (job["state"], job["attempt"], job["progress"], job["started_at"], job["error"]) == ("queued", 1, None, None, None)
    done = finish(server, client, job)
    assert done["error"] is None and done["progress"] | {"rate": None, "remaining_s": None} == {
        "stage": "frames", "done": 3, "total": 3, "rate": None, "remaining_s": None}
    assert done["created_at"] <= done["started_at"] <= done["finished_at"]
    assert made_by(client, job) == {"maps.exr", "report.json", "asset.usdz", "frame.0001.exr", "frame.0002.exr", "frame.0003.exr"}


@pytest.mark.long
def test_a_solve_and_an_export_that_brings_lights_along(server, client, dome, solved, sky):
    job = client.get(f"/v1/jobs/{solved}").json()
    assert job["request"]["options"] == {"albedo_scale": None, "align": False, "align_to": None, "crop": None, "clip_negative": False,
                                         "method": "lambert", "lights": "declared", "intensities": "chosen",
                                         "materials": "coherent", "max_sigma": None, "least_confidence": None}
    assert made_by(client, job) == {"maps.exr", "report.json"}
    assert report_of(server, client, job)["method"] == "lambert"
    exported = finished(server, client, kind="export", maps=solved, format="usdz", rig=dome, environment=sky)
    lights = {"asset_lights/rig.usda", "asset_lights/environment.usda", "asset_lights/environment.exr"}
    assert made_by(client, exported) == {"asset.usdz", *lights}
    assert result(client, exported, "asset_lights/rig.usda").count(b"def DistantLight") >= 4


@pytest.mark.long
def test_a_depth_and_views_of_it_of_maps_and_of_a_capture_alone(server, client, rig, dome, solved):
    job = submit(client, kind="depth", capture=rig, options={"normals": True, "max_residual_px": 2.5}, name="the rig")
    assert (job["request"]["name"], job["request"]["options"]["max_residual_px"]) == ("the rig", 2.5)
    finish(server, client, job)
    assert made_by(client, job) == {"depth.exr", "points.ply", "report.json"}
    exported = finished(server, client, kind="export", maps=job["id"], format="usdc", options={"geometry": "points"})
    layers = {f"asset_layers/{name}" for name in ("payload.usda", "geometry.usdc", "materials.usda")}
    assert made_by(client, exported) == {"asset.usdc", *layers, "asset_textures/base_color.png"}
    shown = {}
    for name, request in {"maps": {"capture": dome, "maps": solved, "options": {"terms": 4}},
                          "depth": {"capture": rig, "maps": job["id"]}, "capture": {"capture": dome}}.items():
        view = finished(server, client, kind="view", **request)
        lit = set() if name == "depth" else {"card_lights.jpg"}
        assert made_by(client, view) == {"view.json", "view.bin", "thumbnails.jpg", "card.jpg"} | lit
        results = f"/v1/jobs/{view['id']}/results"
        shown[name] = client.get(f"{results}/view.json").raise_for_status().json()
        for offset, length in [place for layer in shown[name]["layers"] for place in layer["levels"][0]["tiles"]]:
            tile = client.get(f"{results}/view.bin", headers={"Range": f"bytes={offset}-{offset + length - 1}"})
            assert tile.status_code == 206 and len(zlib.decompress(tile.content)) > 0
    assert [layer["name"] for layer in shown["maps"]["layers"]][:2] == ["normal", "diffuse_albedo"]
    assert shown["maps"]["relight"]["terms"] <= 4 and shown["capture"]["layers"] == []
    assert shown["depth"]["layers"][0]["name"] == "depth" and shown["depth"]["relight"] is None


@pytest.mark.long
def test_a_relight_guided_by_maps_and_lit_by_keys_and_a_shade_under_near_lights(server, client, dome, solved, sky):
    keys = {"schema": "relit.keys/1", "lights": [{"name": "sun", "keys": [
        {"frame": 3, "direction": [0, 0, 1], "irradiance": [1, 1, 1]}, {"frame": 5, "direction": [0.5, 0, 1], "irradiance": [2, 1, 1]}]}]}
    job = finished(server, client, kind="relight", capture=dome, keys=keys, maps=solved,
                   options={"frames": "3-5", "exposure": 1, "aov": ["beauty"]})
    assert made_by(client, job) == {"keys.json", "frame.0003.exr", "frame.0004.exr", "frame.0005.exr"}
    lamp = {"position_m": [0, 0, 300], "intensity": [1e5, 1e5, 1e5]}
    for light in (lamp, "0,0,300,1e5,1e5,1e5"):
        job = finished(server, client, kind="shade", maps=solved, environment=sky, options={"light": [light], "turn_degrees": 90})
        assert made_by(client, job) == {"picture.exr"}


@pytest.mark.long
def test_an_export(server, client, solved):
    job = finished(server, client, kind="export", maps=solved, format="usda", options={"name": "dome"})
    usda = result(client, job, "asset.usda").decode()
    assert usda.startswith("#usda") and "dome" in usda and "@./asset_layers/payload.usda@" in usda
    assert {"asset.usda", *(f"asset_layers/{name}" for name in ("payload.usda", "materials.usda", "geometry.usdc"))} <= made_by(client, job)
    gltf = finished(server, client, kind="export", maps=solved, format="glb")
    glb = client.get(f"/v1/jobs/{gltf['id']}/results/asset.glb").raise_for_status()
    assert glb.content[:4] == b"glTF" and glb.headers["Content-Type"] == "model/gltf-binary"


def test_jobs_are_listed_a_page_at_a_time_the_newest_first(server, client):
    for _ in range(3):  # a page
        succeeded(server, SolveJob(kind="solve", capture=new_id("cap")))
    client.post("/v1/samples/captures").raise_for_status()  # its check is another job
    whole = client.get("/v1/jobs", params={"limit": 500}).raise_for_status().json()
    assert whole["next"] is None and len(whole["jobs"]) > 3
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
    for kinds in (["check"], list(JOBS)):
        found = client.get("/v1/jobs", params={"limit": 500, "kind": kinds}).raise_for_status().json()["jobs"]
        assert [job["id"] for job in found] == [job["id"] for job in whole["jobs"] if job["request"]["kind"] in kinds]
    refused(client.get("/v1/jobs", params={"before": NOBODY}), 404, f"there is no {NOBODY} in this project")
    refused(client.get("/v1/jobs", params={"limit": 0}), 422, "query.limit")
    refused(client.get("/v1/jobs", params={"state": "lost"}), 422, "query.state.0")


@pytest.mark.long
def test_what_a_job_reads_has_to_be_there_and_ready(server, client, dome, sky, solved, rig):
    receiving = client.post("/v1/captures", json={"name": "to come"}).raise_for_status().json()["id"]
    waiting = finished(server, client, kind="depth", capture=rig)
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


def test_a_pipeline_that_relights_nothing_asks_for_no_frames(client, dome):
    job = submit(client, kind="pipeline", capture=dome, priority=0)
    client.post(f"/v1/jobs/{job['id']}/cancel")
    assert job["request"]["relight"]["frames"] is None


def test_addresses_and_methods_that_do_not_exist_are_named(client):
    refused(client.get("/v1/nothing"), 404, "nothing has the address /v1/nothing")
    answer = client.put("/v1/jobs")
    refused(answer, 405, "/v1/jobs takes GET, POST, and not PUT")
    assert answer.headers["Allow"] == "GET, POST"


def test_what_is_no_json_is_said_to_be_none(client):
    refused(client.post("/v1/jobs", content=b'{"kind":', headers={"Content-Type": "application/json"}), 422, "body.8: is no JSON (")


@pytest.mark.parametrize("body, field, message", [
    ({"kind": "check", "intake": "x"}, "body", "must be one of 'solve'"),
    ({"capture": "x"}, "body", "lacks the key kind"),
    ({"kind": "solve"}, "body.solve.capture", "is missing"),
    ({"kind": "solve", "capture": "../owl"}, "body.solve.capture", "give an identifier as the service printed it"),
    ({"kind": "solve", "capture": new_id("cap"), "out": "/etc"}, "body.solve.out", "is not a known key"),
    ({"kind": "solve", "capture": new_id("cap"), "options": {"device": "cuda:0"}}, "body.solve.options.device", "is not a known key"),
    ({"kind": "solve", "capture": new_id("cap"), "options": {"method": "magic"}}, "body.solve.options.method", "magic"),
    ({"kind": "solve", "capture": new_id("cap"), "options": {"align": "yes"}}, "body.solve.options.align", "valid boolean"),
    ({"kind": "solve", "capture": new_id("cap"), "priority": "5"}, "body.solve.priority", "valid integer"),
    ({"kind": "solve", "capture": new_id("cap"), "priority": 2**70}, "body.solve.priority", "less than or equal to 100"),
    ({"kind": "solve", "capture": new_id("cap"), "name": "a\0b"}, "body.solve.name", "string should match pattern"),
    ({"kind": "depth", "capture": new_id("cap"), "options": {"tof": {"calibration": "/etc/passwd"}}},
     "body.depth.options.tof.calibration", "is not a known key"),
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


@pytest.mark.parametrize("method, path", [
    ("GET", ""), ("GET", "/results"), ("GET", "/results/maps.exr"), ("GET", "/events"), ("POST", "/cancel"), ("POST", "/retry"),
    ("POST", "/resume"), ("DELETE", "")])
def test_a_job_that_is_not_there(client, method, path):
    refused(client.request(method, f"/v1/jobs/{NOBODY}{path}"), 404, NOBODY)
    refused(client.request(method, f"/v1/jobs/job_1{path}"), 422, "path.job")
