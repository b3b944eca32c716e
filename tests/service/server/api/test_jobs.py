"""Jobs through the API of a real server: every kind, and how they are listed."""

import zlib

import pytest

from tests.service.server.api.job_calls import NOBODY, finish, made_by, refused, submit


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


def test_a_solve_and_an_export_that_brings_lights_along(server, client, dome, solved, sky):
    job = client.get(f"/v1/jobs/{solved}").json()
    assert job["request"]["options"] == {"albedo_scale": None, "align": False, "align_to": None, "crop": None, "clip_negative": False,
                                         "method": "lambert", "lights": "declared", "intensities": "chosen",
                                         "materials": "coherent", "max_sigma": None, "least_confidence": None}
    assert made_by(client, job) == {"maps.exr", "report.json"}
    report = client.get(f"/v1/jobs/{solved}/results/report.json").raise_for_status().json()
    assert report["method"] == "lambert"
    exported = submit(client, kind="export", maps=solved, format="usdz", rig=dome, environment=sky)
    finish(server, client, exported)
    lights = {"asset_lights/rig.usda", "asset_lights/environment.usda", "asset_lights/environment.exr"}
    assert made_by(client, exported) == {"asset.usdz", *lights}
    rig = client.get(f"/v1/jobs/{exported['id']}/results/asset_lights/rig.usda").raise_for_status()
    assert rig.content.count(b"def DistantLight") >= 4


@pytest.mark.long
def test_a_depth_and_views_of_it_of_maps_and_of_a_capture_alone(server, client, rig, dome, solved):
    job = submit(client, kind="depth", capture=rig, options={"normals": True, "max_residual_px": 2.5}, name="the rig")
    assert (job["request"]["name"], job["request"]["options"]["max_residual_px"]) == ("the rig", 2.5)
    finish(server, client, job)
    assert made_by(client, job) == {"depth.exr", "points.ply", "report.json"}
    exported = submit(client, kind="export", maps=job["id"], format="usdc", options={"geometry": "points"})
    finish(server, client, exported)
    layers = {f"asset_layers/{name}" for name in ("payload.usda", "geometry.usdc", "materials.usda")}
    assert made_by(client, exported) == {"asset.usdc", *layers, "asset_textures/base_color.png"}
    shown = {}
    for name, request in {"maps": {"capture": dome, "maps": solved, "options": {"terms": 4}},
                          "depth": {"capture": rig, "maps": job["id"]}, "capture": {"capture": dome}}.items():
        view = submit(client, kind="view", **request)
        finish(server, client, view)
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
    job = submit(client, kind="relight", capture=dome, keys=keys, maps=solved, options={"frames": "3-5", "exposure": 1, "aov": ["beauty"]})
    finish(server, client, job)
    assert made_by(client, job) == {"keys.json", "frame.0003.exr", "frame.0004.exr", "frame.0005.exr"}
    lamp = {"position_m": [0, 0, 300], "intensity": [1e5, 1e5, 1e5]}
    for light in (lamp, "0,0,300,1e5,1e5,1e5"):
        job = submit(client, kind="shade", maps=solved, environment=sky, options={"light": [light], "turn_degrees": 90})
        finish(server, client, job)
        assert made_by(client, job) == {"picture.exr"}


def test_an_export(server, client, solved):
    job = submit(client, kind="export", maps=solved, format="usda", options={"name": "dome"})
    gltf = submit(client, kind="export", maps=solved, format="glb")
    finish(server, client, job)
    usda = client.get(f"/v1/jobs/{job['id']}/results/asset.usda").raise_for_status().text
    assert usda.startswith("#usda") and "dome" in usda and "@./asset_layers/payload.usda@" in usda
    assert {"asset.usda", *(f"asset_layers/{name}" for name in ("payload.usda", "materials.usda", "geometry.usdc"))} <= made_by(client, job)
    finish(server, client, gltf)
    glb = client.get(f"/v1/jobs/{gltf['id']}/results/asset.glb").raise_for_status()
    assert glb.content[:4] == b"glTF" and glb.headers["Content-Type"] == "model/gltf-binary"


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
