"""A whole pipeline through a real server whose captures and results lie in an object store."""

import hashlib

import numpy as np
import pytest

from service.server.storage import layout
from tests.scenes.captures import files_in, make_scene, write_capture, write_exr
from tests.service.server.api.tus import Tus
from tests.service.server_process import serving


def sent(client, tus, kind, files):
    """Upload files and have them checked; the identifier."""
    place = f"/v1/{kind}"
    made = client.post(place, json={"name": "cap"}).raise_for_status().json()["id"]
    for path in files:
        tus.send(f"{place}/{made}", path.name, path.read_bytes())
    client.post(f"{place}/{made}/validate").raise_for_status()
    return made


@pytest.mark.long
def test_a_pipeline_with_uploads_in_an_object_store(relit, tmp_path, url):
    capture = write_capture(tmp_path / "cap", make_scene(size=16, lights=6))
    sky = write_exr(tmp_path / "sky.exr", np.random.default_rng(3).random((8, 16, 3)))
    with serving(tmp_path / "server", "--anonymous", "--device", "cpu", storage_url=url, chunk_frames="2") as server, \
            server.client() as client:
        tus = Tus(server.url)
        cap = sent(client, tus, "captures", sorted(capture.glob("*.*")))
        env = sent(client, tus, "environments", [sky])
        for place in (f"/v1/captures/{cap}", f"/v1/environments/{env}"):
            found = server.wait(client, place, ("ready", "refused"))
            assert (found["state"], found["problem"]) == ("ready", None)
        asked = {"kind": "pipeline", "capture": cap, "environment": env, "solve": {"method": "lambert"}, "guided": True,
                 "relight": {"frames": "1-5", "spin_degrees": 90}}
        job = client.post("/v1/jobs", json=asked).raise_for_status().json()["id"]
        done = server.wait(client, f"/v1/jobs/{job}", ("succeeded", "failed"))
        assert (done["state"], done["error"]) == ("succeeded", None)
        assert not (server.data / "projects").exists()  # nothing lies in the data folder but copies
        results = f"/v1/jobs/{job}/results"
        names = {"maps.exr", "report.json", "asset.usdz", *(f"frame.{number:04d}.exr" for number in range(1, 6))}
        listed = client.get(results).raise_for_status().json()
        assert {file["name"] for file in next(value for value in listed.values() if isinstance(value, list))} == names
        got = {name: client.get(f"{results}/{name}").raise_for_status().content for name in names}
        assert client.get(f"{results}/maps.exr", headers={"Range": "bytes=0-3"}).content == got["maps.exr"][:4]
        assert client.get(f"{results}/none.exr").status_code == 404
        (tmp_path / "maps").mkdir()
        (tmp_path / "maps" / "maps.exr").write_bytes(got["maps.exr"])
        assert relit("relight", capture, "--environment", sky, "--maps", tmp_path / "maps", "--frames", "1-5", "--spin-degrees", "90",
                     "--out", tmp_path / "here" / "frame.####.exr").code == 0
        for name in files_in(tmp_path / "here"):
            assert hashlib.sha256(got[name]).digest() == hashlib.sha256((tmp_path / "here" / name).read_bytes()).digest()
        if url.startswith("file:"):  # where docs/service_storage.md says
            prefix = tmp_path / "store" / layout.results("default", job)
            assert {name: (prefix / name).read_bytes() for name in files_in(prefix)} == got
        client.delete(f"/v1/jobs/{job}").raise_for_status()
        client.delete(f"/v1/captures/{cap}").raise_for_status()
        assert client.get(results).status_code == 404
        if url.startswith("file:"):
            assert {name.split("/")[2] for name in files_in(tmp_path / "store") if name.startswith("projects/")} == {"environments"}


def test_a_server_with_a_store_that_cannot_be_is_refused(tmp_path, relit, monkeypatch):
    monkeypatch.setenv("RELIT_STORAGE_URL", "ftp://store")
    outcome = relit("serve", "--data", tmp_path / "data", "--port", "0", "--device", "none")
    outcome.refused("storage_url: give s3://bucket/prefix or file:///folder")
