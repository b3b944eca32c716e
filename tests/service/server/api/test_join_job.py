"""Joining as a job: maps and a depth that other jobs have made of one view."""


import numpy as np
import pytest

from stage.results.maps import SurfaceMaps
from tests.reference import projector as reference
from tests.scenes.captures import write_exr, write_manifest
from tests.scenes.depth import BLACK_WHITE, CENTRE, NORMAL, RADIUS, entry_of, gray_patterns, make_scene, phase_patterns, write_patterns
from tests.service.server.api.job_calls import NOBODY, finish, made_by, refused, submit
from tests.service.server.api.test_measuring import files_of, upload

pytestmark = pytest.mark.long

CAMERA = reference.Device(96, 72, 140.0)
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
