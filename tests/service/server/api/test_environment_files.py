"""The image of an environment is sent as it is, whole or in part, and nothing but it."""

import pytest

from tests.service.server.api.conftest import SAMPLES

FILE = SAMPLES / "owl" / "environment.exr"


def test_the_file_is_sent_as_it_is(client, sky):
    answer = client.get(f"/v1/environments/{sky}/file")
    assert answer.status_code == 200 and answer.content == FILE.read_bytes()
    assert answer.headers["content-disposition"] == 'attachment; filename="environment.exr"'
    part = client.get(f"/v1/environments/{sky}/file", headers={"Range": "bytes=4-11"})
    assert part.status_code == 206 and part.content == FILE.read_bytes()[4:12]


def test_an_uploaded_file_is_sent(server, client):
    made = client.post("/v1/environments", json={"name": "sky"}).json()["id"]
    upload = client.post(f"/v1/environments/{made}/files", headers={
        "Tus-Resumable": "1.0.0", "Upload-Length": str(FILE.stat().st_size), "Upload-Metadata": "path c2t5LmV4cg=="}).json()["upload"]
    assert client.get(f"/v1/environments/{made}/file").status_code == 409
    client.patch(f"/v1/uploads/{upload}", content=FILE.read_bytes(), headers={
        "Tus-Resumable": "1.0.0", "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}).raise_for_status()
    client.post(f"/v1/environments/{made}/validate").raise_for_status()
    assert server.wait(client, f"/v1/environments/{made}", ("ready", "refused"))["state"] == "ready"
    answer = client.get(f"/v1/environments/{made}/file")
    assert answer.content == FILE.read_bytes() and 'filename="sky.exr"' in answer.headers["content-disposition"]


@pytest.mark.long
@pytest.mark.parametrize("how", ["link", "gone"])
def test_a_registered_file_that_became_a_link_is_not_sent(server, client, registered, tmp_path, how):
    file = registered / f"{how}.exr"
    file.write_bytes(FILE.read_bytes())
    made = client.post("/v1/environments", json={"name": how, "file": str(file)}).raise_for_status().json()["id"]
    assert server.wait(client, f"/v1/environments/{made}", ("ready", "refused"))["state"] == "ready"
    foreign = tmp_path / "foreign.exr"
    foreign.write_bytes(b"foreign")
    file.unlink()
    if how == "link":
        file.symlink_to(foreign)
    answer = client.get(f"/v1/environments/{made}/file")
    assert answer.status_code == 404 and "not there any more" in answer.json()["detail"]


def test_an_unknown_environment(client):
    assert client.get("/v1/environments/env_0123456789abcdefghjk/file").status_code == 404
