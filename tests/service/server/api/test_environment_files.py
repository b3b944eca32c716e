"""The image of an environment is sent as it is, whole or in part, and nothing but it."""

import pytest

from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import admitted
from tests.service.server.api.tus import encoded

FILE = SAMPLES / "owl" / "environment.exr"


def test_the_file_is_sent_as_it_is_and_so_is_an_uploaded_one(client, sky, server, tus):
    answer = client.get(f"/v1/environments/{sky}/file")
    assert answer.status_code == 200 and answer.content == FILE.read_bytes()
    assert answer.headers["content-disposition"] == 'attachment; filename="environment.exr"'
    part = client.get(f"/v1/environments/{sky}/file", headers={"Range": "bytes=4-11"})
    assert part.status_code == 206 and part.content == FILE.read_bytes()[4:12]
    place = f"/v1/environments/{client.post('/v1/environments', json={'name': 'sky'}).json()['id']}"
    upload = tus.create(place, FILE.stat().st_size, encoded(path="sky.exr")).headers["location"]
    assert client.get(f"{place}/file").status_code == 409
    assert tus.patch(upload, 0, FILE.read_bytes()).status == 204
    client.post(f"{place}/validate").raise_for_status()
    assert server.wait(client, place, ("ready", "refused"))["state"] == "ready"
    answer = client.get(f"{place}/file")
    assert answer.content == FILE.read_bytes() and 'filename="sky.exr"' in answer.headers["content-disposition"]
    assert client.get("/v1/environments/env_0123456789abcdefghjk/file").status_code == 404


@pytest.mark.long
@pytest.mark.parametrize("how", ["link", "gone"])
def test_a_registered_file_that_became_a_link_is_not_sent(server, client, registered, tmp_path, how):
    file = registered / f"{how}.exr"
    file.write_bytes(FILE.read_bytes())
    made = admitted(server, client, file, kind="environments")["id"]
    foreign = tmp_path / "foreign.exr"
    foreign.write_bytes(b"foreign")
    file.unlink()
    if how == "link":
        file.symlink_to(foreign)
    answer = client.get(f"/v1/environments/{made}/file")
    assert answer.status_code == 404 and "not there any more" in answer.json()["detail"]
