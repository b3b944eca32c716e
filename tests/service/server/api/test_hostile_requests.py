"""Bad requests, names and metadata to a real server: refused by name, logged once, nothing left behind."""

import json

import pytest

from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.tus import encoded
from tests.service.waiting import until

pytestmark = pytest.mark.usefixtures("worker_lives")


def test_bad_requests_are_refused_by_name_and_logged_once(server, client, registered):
    (registered / "out").symlink_to(SAMPLES.parent)
    (registered / "circle").symlink_to(registered / "circle")
    (registered / "file").write_text("no folder")
    bad = [
        ("/v1/captures", {"name": "x", "colour": "red"}, "colour"),
        ("/v1/captures", {}, "name"),
        ("/v1/captures", {"name": ""}, "name"),
        ("/v1/captures", {"name": "a\0b"}, "name"),
        ("/v1/captures", {"name": "half \ud800"}, ""),
        ("/v1/captures", {"name": "x" * 201}, "name"),
        ("/v1/captures", {"name": 5}, "name"),
        ("/v1/captures", {"name": "x", "folder": "relative"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": ""}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/../data"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/a\0b"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/\ud800"}, ""),
        ("/v1/captures", {"name": "x", "folder": "/etc"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": str(server.data)}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/out/tests"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/circle"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/nothing"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/file"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/{'x' * 5000}"}, "folder"),
        ("/v1/environments", {"name": "x", "file": str(registered)}, "file"),
        ("/v1/jobs", {"kind": "depth", "capture": "cap_0123456789abcdefghjk", "tof_calibration": "a\0b"}, "tof_calibration"),
        ("/v1/jobs", {"kind": "relight", "capture": "cap_0123456789abcdefghjk", "options": {"frames": "1\0"}}, "frames"),
        ("/v1/environments", {"name": "x", "file": "/etc/passwd"}, "file"),
        ("/v1/environments", {"name": "x", "folder": "/etc"}, "folder"),
    ]
    count = len(client.get("/v1/captures", params={"limit": 500}).json()["items"])
    refused = []
    for path, body, field in bad:
        answer = client.post(path, content=json.dumps(body), headers={"Content-Type": "application/json"})
        assert answer.status_code in (400, 422), (body, answer.text)
        problem = answer.json()
        assert problem["status"] == answer.status_code and field in problem["detail"], (body, problem)
        assert "passwd" not in problem["detail"]
        refused.append(problem["request_id"])
    assert [len(lines_of(server, request)) for request in refused] == [1] * len(bad)
    assert len(client.get("/v1/captures", params={"limit": 500}).json()["items"]) == count


def lines_of(server, request_id: str) -> list[dict]:
    """What was logged of a request; the last line of it may come after its answer."""
    return until(lambda: [line for line in server.lines() if line.get("request") == request_id])


@pytest.mark.parametrize("path", [
    "../capture.json", "a/../../b", "/etc/passwd", "C:/x", "\\\\server\\share", "a\\b", "nul\0", "new\nline", "\u202egnp.exe",
    "zero\u200bwidth", "e\u0301.exr", ".hidden", "a/.part", "CON", "aux.exr", "end.", "end ", "x" * 256, "/".join("abcdefghi"), ""])
def test_names_that_are_not_safe_are_refused_and_leave_nothing(server, client, tus, capture, path):
    def parts() -> set:
        return set((server.data / "uploads").glob("*"))

    before = parts()
    answer = tus.create(capture, 4, encoded(path=path))
    problem = json.loads(answer.body)
    assert (answer.status, problem["detail"].startswith("path ")) == (422, True)
    assert problem["detail"].isprintable()
    assert client.get(f"{capture}/files").json()["files"] == [] and parts() == before
    assert [line["problem"] for line in lines_of(server, problem["request_id"])] == [problem["detail"]]


@pytest.mark.parametrize(("first", "second"), [
    ("Frame.exr", "frame.EXR"), ("straße", "STRASSE"), ("a/x", "A/y"), ("a", "a/b"), ("A", "a/b"), ("a/b", "a"), ("a/b/c", "a/B")])
def test_names_that_are_one_without_case_are_refused(client, tus, capture, first, second):
    tus.send(capture, first, b"first")
    answer = tus.create(capture, 4, encoded(path=second))
    assert (answer.status, first in json.loads(answer.body)["detail"]) == (409, True)
    assert [file["path"] for file in client.get(f"{capture}/files").json()["files"]] == [first]


@pytest.mark.parametrize("metadata", ["", "path", "filename YQ==", "path YQ==,owner YQ==", "path YQ==,path Yg==", "path !!!", "path /w==",
                                      "path YQ==,sha256 YQ==", "sha256 YQ=="])
def test_metadata_that_is_not_known_is_refused(tus, capture, metadata):
    answer = tus.create(capture, 4, metadata)
    assert (answer.status, json.loads(answer.body)["detail"].startswith(("Upload-Metadata", "path "))) == (422, True)
