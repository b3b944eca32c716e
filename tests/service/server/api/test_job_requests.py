"""Requests for jobs that are refused, and values at the edge of what is taken."""

import re

import httpx2
import pytest

from service.requests.base.identifiers import new_id
from service.server.database.engine import storable
from tests.service.server.api.job_calls import NOBODY, finish, refused, submit


@pytest.mark.long
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
