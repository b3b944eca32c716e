"""Registration and fusion as jobs: the depths that other jobs have decoded become one mesh."""

import json

import numpy as np
import pytest

from stage.results.maps import SurfaceMaps
from tests.reference import projector as reference
from tests.scenes.captures import write_exr, write_manifest
from tests.scenes.depth import (
    BLACK_WHITE,
    CENTRE,
    NORMAL,
    POSE,
    PROJECTOR,
    RADIUS,
    Scene,
    entry_of,
    gray_patterns,
    make_scene,
    phase_patterns,
    write_patterns,
)
from tests.service.server.api.job_calls import NOBODY, finish, made_by, refused, submit
from tests.service.server.api.test_measuring import files_of, upload

pytestmark = pytest.mark.long

CAMERA = reference.Device(96, 72, 140.0)
ASIDE_M = 0.1
"""By how much the camera of the second view stands to the right."""


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distance of a surface from the plane of the camera, whose bumps are nowhere alike."""
    return 1.4 + 0.09 * np.sin(9 * x + 4 * y * y) * np.cos(8 * y - 1) + 0.06 * np.sin(13 * y + 6 * x * x + 2) - 0.12 * np.exp(
        -((x - 0.15) ** 2 + (y - 0.1) ** 2) / 0.01)


def seen_from(aside_m: float) -> tuple[Scene, np.ndarray]:
    """The view of a camera that stands aside, and the projector as it sees it; no part of the surface hides another."""
    rays = reference.pixel_rays(CAMERA)
    depth = np.full(rays.shape[:2], 1.4)
    for _ in range(60):  # damped: along a ray the surface changes by less than the ray does
        points = rays * (depth / -rays[..., 2])[..., None]
        depth = 0.5 * depth + 0.5 * height(points[..., 0] + aside_m, points[..., 1])
    points = rays * (depth / -rays[..., 2])[..., None]
    pose = POSE.copy()
    pose[0, 3] -= aside_m
    albedo = np.full((*depth.shape, 3), 0.6)
    return Scene(depth, points, reference.seen_by(PROJECTOR, pose, points), albedo, np.zeros(depth.shape, dtype=bool)), pose


@pytest.fixture(scope="module")
def depths(tmp_path_factory, server, client) -> list[str]:
    """The jobs that decoded two views of one surface."""
    jobs = []
    for number, aside in enumerate((0.0, ASIDE_M)):
        folder = tmp_path_factory.mktemp("view")
        scene, pose = seen_from(aside)
        write_patterns(folder, scene, [*gray_patterns("column", stripe=8), *phase_patterns("column", 16.0), *BLACK_WHITE],
                       noise=0.001, camera=CAMERA, pose=pose)
        jobs.append(submit(client, kind="depth", capture=upload(server, client, files_of(folder))["id"], name=f"view {number}"))
    return [finish(server, client, job)["id"] for job in jobs]


@pytest.fixture(scope="module")
def registered(server, client, depths) -> str:
    return finish(server, client, submit(client, kind="register", depths=depths, options={"reference": depths[0]}))["id"]


def test_depths_are_placed_and_named_by_their_jobs(client, server, depths, registered):
    assert made_by(client, {"id": registered}) == {"scan-set.json", "report.json"}
    found = client.get(f"/v1/jobs/{registered}/results/scan-set.json").json()
    assert [(scan["name"], scan["path"]) for scan in found["scans"]] == [(job, job) for job in depths]
    pose = np.array(found["scans"][1]["scan_to_world"])
    assert np.abs(pose[:3, 3] - [ASIDE_M, 0, 0]).max() < 5e-3  # metres: half of the distance between two pixels on the surface
    assert np.degrees(np.arccos(np.clip((np.trace(pose[:3, :3]) - 1) / 2, -1, 1))) < 0.5
    report = client.get(f"/v1/jobs/{registered}/results/report.json").json()
    assert str(server.data) not in json.dumps(report) and "/relit-scans-" not in json.dumps(report)


def test_registered_depths_become_one_mesh(client, server, depths, registered):
    job = submit(client, kind="fuse", registered=registered, options={"texture_px": 128, "texture_faces": 1000})
    finish(server, client, job)
    assert made_by(client, job) >= {"mesh.ply", "asset.usdc", "report.json"}
    report = client.get(f"/v1/jobs/{job['id']}/results/report.json").json()
    assert [scan["name"] for scan in report["scans"]] == depths and all(scan["fused"] for scan in report["scans"])
    assert str(server.data) not in json.dumps(report) and "/relit-scans-" not in json.dumps(report)


def test_what_cannot_be_registered_or_fused_is_refused(client, depths, registered):
    def ask(**request):
        return client.post("/v1/jobs", json=request)

    refused(ask(kind="register", depths=[depths[0], registered]), 422, f"depths[1]: {registered} is a register job: give one of depth")
    refused(ask(kind="register", depths=[depths[0], NOBODY]), 404, "depths[1]: ")
    refused(ask(kind="register", depths=[depths[0], depths[0]]), 422, "names a job twice")
    refused(ask(kind="register", depths=depths, solves=[depths[0]]), 422, "has 1 jobs for 2 depths")
    refused(ask(kind="fuse", registered=depths[0]), 422, "is a depth job: give one of register")


TILT = 0.6
"""Tangent of the angle between each light and the camera's axis."""


@pytest.fixture(scope="module")
def view(tmp_path_factory, server, client) -> dict[str, str]:
    """A sphere before a plane, seen by one camera: under eight lights and under patterns. The jobs that solved and decoded it."""
    folder, scene = tmp_path_factory.mktemp("view"), make_scene(camera=CAMERA)
    write_patterns(folder / "patterns", scene, [*gray_patterns("column", stripe=8), *phase_patterns("column", 16.0), *BLACK_WHITE],
                   noise=0.002, camera=CAMERA)
    off_centre = scene.points - CENTRE
    on_sphere = np.linalg.norm(off_centre, axis=-1) < RADIUS * 1.001
    normal = np.where(on_sphere[..., None], off_centre / RADIUS, np.array(NORMAL) / np.linalg.norm(NORMAL))
    frames = []
    for number, angle in enumerate(np.arange(8) * np.pi / 4):
        direction = np.array([TILT * np.cos(angle), TILT * np.sin(angle), 1.0]) / np.hypot(TILT, 1)
        write_exr(folder / "lights" / f"{number}.exr", scene.albedo / np.pi * np.clip(normal @ direction, 0, None)[..., None])
        light = {"type": "distant", "direction": direction.tolist(), "irradiance": [1, 1, 1]}
        frames.append({"image": f"{number}.exr", "light": light})
    camera = {"projection": "perspective", **entry_of(CAMERA)}
    write_manifest(folder / "lights", {"schema": "relit.capture/1", "name": "lights", "camera": camera, "frames": frames})
    jobs = {}
    for name, kind, options in (("lights", "solve", {"method": "lambert"}), ("patterns", "depth", {})):
        jobs[name] = submit(client, kind=kind, capture=upload(server, client, files_of(folder / name))["id"], options=options)
    return {name: finish(server, client, job)["id"] for name, job in jobs.items()}


def maps_of(client, job: str, folder) -> SurfaceMaps:
    (folder / f"{job}.exr").write_bytes(client.get(f"/v1/jobs/{job}/results/maps.exr").raise_for_status().content)
    return SurfaceMaps.read(folder / f"{job}.exr")


def test_the_joined_maps_lie_where_the_depth_is_and_are_exported(server, client, view, tmp_path):
    job = submit(client, kind="join", maps=view["lights"], depth=view["patterns"])
    finish(server, client, job)
    assert made_by(client, job) == {"maps.exr", "report.json"}
    found, truth = maps_of(client, job["id"], tmp_path), make_scene(camera=CAMERA).depth
    assert found.height is not None and found.mask.mean() > 0.8
    error = np.abs(-found.height - truth)[found.mask]
    assert np.median(error) < 2e-3  # metres: the depth alone has .3 mm, the height of a solve by itself is off by what is unknown of it
    asset = submit(client, kind="export", maps=job["id"], format="glb")
    finish(server, client, asset)
    assert "asset.glb" in made_by(client, asset)


def test_what_cannot_be_joined_is_refused(client, view):
    swapped = client.post("/v1/jobs", json={"kind": "join", "maps": view["patterns"], "depth": view["lights"]})
    refused(swapped, 422, "maps: " + view["patterns"] + " is a depth job: give one of solve, pipeline")
    refused(client.post("/v1/jobs", json={"kind": "join", "maps": view["lights"], "depth": NOBODY}), 404, "depth: ")
