"""Registration, fusion and joining as jobs, of depths and maps that other jobs have made."""

import numpy as np
import pytest

from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import DepthJob, SolveJob
from stage.results.depth_maps import DepthMaps
from stage.results.maps import SurfaceMaps
from tests.scenes.register import seen
from tests.scenes.turntable import figure
from tests.service.joining.test_join import write
from tests.service.server.api.job_calls import NOBODY, finished, made_by, refused, report_of, result, succeeded

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def views():
    return seen(figure, 0, 30, 60)


@pytest.fixture(scope="module")
def depths(server, views) -> list[str]:
    """Jobs with the depths of three views, whose poses are known to some millimetres."""
    names, random = [], np.random.default_rng(3)
    for view in views:
        results = succeeded(server, DepthJob(kind="depth", capture=new_id(CAPTURE)))
        pose = view.world_from_scan.copy()
        pose[:3, 3] += random.normal(scale=0.002, size=3)
        camera = view.camera.model_copy(update={"world_from_camera": tuple(map(tuple, pose.tolist()))})
        DepthMaps(camera=camera, mask=view.mask, depth=view.depth, sigma=view.sigma).write(results / "depth.exr")
        names.append(results.name)
    return names


@pytest.fixture(scope="module")
def registered(server, client, depths) -> str:
    return finished(server, client, kind="register", depths=depths, options={"reference": depths[0]})["id"]


def test_depths_are_placed_and_named_by_their_jobs(client, server, depths, registered, views):
    assert made_by(client, {"id": registered}) == {"scan-set.json", "report.json"}
    found = report_of(server, client, {"id": registered}, "scan-set.json")
    assert [(scan["name"], scan["path"]) for scan in found["scans"]] == [(job, job) for job in depths]
    first, second = (np.array(scan["scan_to_world"]) for scan in found["scans"][:2])
    moved = np.linalg.inv(first) @ second - np.linalg.inv(views[0].world_from_scan) @ views[1].world_from_scan
    assert np.abs(moved[:3, 3]).max() < 1e-3  # of the 2 mm that the starts are off; the figure is .2 m high
    assert report_of(server, client, {"id": registered})["schema"].startswith("relit.")


def test_registered_depths_become_one_mesh(client, server, depths, registered):
    job = finished(server, client, kind="fuse", registered=registered, options={"texture_px": 128, "texture_faces": 1000})
    assert made_by(client, job) >= {"mesh.ply", "asset.usdc", "report.json"}
    report = report_of(server, client, job)
    assert [scan["name"] for scan in report["scans"]] == depths and all(scan["fused"] for scan in report["scans"])


def test_what_cannot_be_registered_or_fused_is_refused(client, depths, registered):
    def ask(**request):
        return client.post("/v1/jobs", json=request)

    refused(ask(kind="register", depths=[depths[0], registered]), 422, f"depths[1]: {registered} is a register job: give one of depth")
    refused(ask(kind="register", depths=[depths[0], NOBODY]), 404, "depths[1]: ")
    refused(ask(kind="register", depths=[depths[0], depths[0]]), 422, "names a job twice")
    refused(ask(kind="register", depths=depths, solves=[depths[0]]), 422, "has 1 jobs for 3 depths")
    refused(ask(kind="fuse", registered=depths[0]), 422, "is a depth job: give one of register")


@pytest.fixture(scope="module")
def view(server, tmp_path_factory) -> dict[str, str]:
    """The jobs that solved and decoded one view of a wave."""
    lights, patterns, *_ = write(tmp_path_factory.mktemp("view"))
    solved = succeeded(server, SolveJob(kind="solve", capture=new_id(CAPTURE)))
    decoded = succeeded(server, DepthJob(kind="depth", capture=new_id(CAPTURE)))
    return {"lights": lights.rename(solved).name, "patterns": patterns.rename(decoded).name}


def test_the_joined_maps_lie_where_the_depth_is_and_are_exported(server, client, view, tmp_path):
    job = finished(server, client, kind="join", maps=view["lights"], depth=view["patterns"])
    assert made_by(client, job) == {"maps.exr", "report.json"}
    (tmp_path / "maps.exr").write_bytes(result(client, job, "maps.exr"))
    found = SurfaceMaps.read(tmp_path / "maps.exr")
    assert found.height is not None and abs(np.median(found.height[found.mask]) + 0.5) < 0.02  # where the depth is, not the solve
    asset = finished(server, client, kind="export", maps=job["id"], format="glb")
    assert "asset.glb" in made_by(client, asset)


def test_what_cannot_be_joined_is_refused(client, view):
    swapped = client.post("/v1/jobs", json={"kind": "join", "maps": view["patterns"], "depth": view["lights"]})
    refused(swapped, 422, "maps: " + view["patterns"] + " is a depth job: give one of solve, pipeline")
    refused(client.post("/v1/jobs", json={"kind": "join", "maps": view["lights"], "depth": NOBODY}), 404, "depth: ")
