"""Jobs through the API of a real server."""


def test_a_pipeline_solves_exports_and_relights(server, client, owl, sky):
    job = client.post("/v1/jobs", json={"kind": "pipeline", "capture": owl, "environment": sky, "solve": {"method": "lambert"},
                                        "relight": {"frames": "1-3", "spin_degrees": 360}}).raise_for_status().json()
    assert job["state"] == "queued"
    done = server.wait(client, f"/v1/jobs/{job['id']}", ("succeeded", "failed"))
    assert (done["state"], done["error"]) == ("succeeded", None)
    made = {path.name for path in (server.data / "projects/default/jobs" / job["id"]).iterdir()}
    assert made == {"maps.exr", "report.json", "asset.usdz", "frame.0001.exr", "frame.0002.exr", "frame.0003.exr"}
