"""Sequences as jobs: an uploaded folder of captures is solved or measured step by step, exported with time samples, and relit."""

import json

import pytest
from pxr import Usd, UsdGeom

from tests.scenes import depth as depths
from tests.scenes.sequence import write_sequence
from tests.service.server.api.job_calls import error_of, finish, finished, made_by, refused, report_of, result, submit
from tests.service.server.api.test_measuring import files_of, upload

pytestmark = pytest.mark.long

TIMES = [0.0, 0.1, 0.2]


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("sequence")
    write_sequence(folder, [None] * len(TIMES), noise=0.01, size=16, times=TIMES)
    return files_of(folder)


@pytest.fixture(scope="module")
def sequence(server, client, files) -> str:
    found = upload(server, client, files)
    assert (found["facts"]["steps"], found["facts"]["captures"]) == (3, 3)
    return found["id"]


@pytest.fixture(scope="module")
def solved(server, client, sequence) -> str:
    return finished(server, client, kind="solve", capture=sequence, options={"method": "lambert"})["id"]


def results_of(step: str, *names: str) -> set[str]:
    return {f"{step}/{name}" for name in (*names, *(f"alone/{name}" for name in (*names, "step.json")))}


def test_every_step_is_solved_and_joined(server, client, sequence, solved):
    steps = set().union(*(results_of(f"step{step:02d}", "maps.exr", "report.json") for step in range(3)))
    assert made_by(client, {"id": solved}) == {"sequence.json", "report.json", *steps}
    written = report_of(server, client, {"id": solved}, "sequence.json")
    assert [(step["path"], step["time_s"]) for step in written["steps"]] == [(f"step{step:02d}", time) for step, time in enumerate(TIMES)]
    report = report_of(server, client, {"id": solved})
    assert report["steps"][2]["steps_joined"]["most"] == 3 and report["inputs"]["sequence"] == sequence
    told = [entry["text"] for entry in client.get(f"/v1/jobs/{solved}/log").json()["entries"]]
    assert [any(text.startswith(f"{step}/3 normals") for text in told) for step in (1, 2, 3)] == [True] * 3


def test_the_results_become_one_asset_with_time_samples(server, client, solved, tmp_path):
    job = finished(server, client, kind="export", maps=solved, format="usdc")
    asset = tmp_path / "asset.usdc"
    asset.write_bytes(result(client, job, "asset.usdc"))
    stage = Usd.Stage.Open(str(asset))
    mesh, = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    assert UsdGeom.Mesh(mesh).GetPointsAttr().GetTimeSamples() == pytest.approx([0, 3, 6])  # at 30 a second
    for unfit in ("usda", "glb"):
        refused(client.post("/v1/jobs", json={"kind": "export", "maps": solved, "format": unfit}), 422,
                f"format: is {unfit}, the asset of a sequence is one of usdz")


def test_one_step_is_looked_at(server, client, sequence, solved, dome):
    def ask(**request):
        return client.post("/v1/jobs", json={"kind": "view", "capture": sequence, **request})

    view = finished(server, client, kind="view", capture=sequence, maps=solved, step=2)
    shown = report_of(server, client, view, "view.json")
    assert shown["name"] == "step01" and "normal" in {layer["name"] for layer in shown["layers"]}
    alone = finished(server, client, kind="view", capture=sequence, step=3)
    assert report_of(server, client, alone, "view.json")["name"] == "step02"
    for unfit in ({}, {"step": 4}):
        refused(ask(**unfit), 422, f"{sequence} is a sequence of 3 captures: give the number of one, 1")
    refused(ask(capture=dome, step=1), 422, f"step: {dome} is one capture, and no sequence")
    refused(ask(capture=dome, maps=solved), 422, f"maps: {solved} is of a sequence: give the job of one capture")
    one = finished(server, client, kind="solve", capture=dome, options={"method": "lambert"})["id"]
    refused(ask(maps=one, step=1), 422, f"maps: {one} is of one capture, and {sequence} is a sequence")


def test_a_pipeline_of_a_sequence(server, client, sequence, sky):
    job = submit(client, kind="pipeline", capture=sequence, environment=sky, format="usdz", guided=True, solve={"method": "lambert"},
                 sequence={"temporal": False})
    done = finish(server, client, job)
    assert done["request"]["relight"]["frames"] == "1-3"
    made = made_by(client, job)
    assert {"asset.usdz", "step02/maps.exr", "frame.0001.exr", "frame.0002.exr", "frame.0003.exr"} <= made
    assert not any("alone" in name for name in made)


def test_a_depth_of_a_sequence(server, client, tmp_path):
    patterns = [*depths.BLACK_WHITE, *depths.phase_patterns("column", 16), *depths.gray_patterns("column", stripe=16)]
    for step in range(2):
        depths.write_patterns(tmp_path / f"s{step}", depths.make_scene(sphere=False), patterns, noise=0.01, seed=step)
    found = upload(server, client, files_of(tmp_path))
    job = finished(server, client, kind="depth", capture=found["id"], sequence={"frame_rate": 12.5})
    made = made_by(client, job)
    assert made == {"sequence.json", "report.json", *results_of("s0", "depth.exr", "points.ply", "report.json"),
                    *results_of("s1", "depth.exr", "points.ply", "report.json")}
    assert report_of(server, client, job, "sequence.json")["frames_per_second"] == 12.5


def test_what_takes_one_capture_is_given_one(server, client, sequence, solved, dome, rig):
    def ask(**request):
        return client.post("/v1/jobs", json=request)

    alone = f"{sequence} is a sequence of 3 captures: give one capture here"
    refused(ask(kind="basis", capture=sequence), 422, f"capture: {alone}")
    refused(ask(kind="calibrate-procam", captures=[sequence], options={"board": "9x6", "square_m": 0.03}), 422, f"captures: {alone}")
    refused(ask(kind="solve", capture=sequence, reference_ball=sequence), 422, f"reference_ball: {alone}")
    refused(ask(kind="solve", capture=dome, sequence={"temporal": False}), 422, f"sequence: {dome} is one capture")
    refused(ask(kind="depth", capture=rig, sequence={"frame_rate": 12}), 422, f"sequence: {rig} is one capture")
    refused(ask(kind="pipeline", capture=sequence, format="glb"), 422, "format: is glb, the asset of a sequence is one of usdz, usdc")
    of_one = f"maps: {solved} is of a sequence: "
    refused(ask(kind="shade", maps=solved), 422, of_one)
    refused(ask(kind="solve", capture=sequence, sequence={"frame_rate": 0}), 422, "frame_rate")
    assert "frames_per_second: is 30, --frame-rate 12: leave one out" in error_of(
        server, client, kind="solve", capture=sequence, sequence={"frame_rate": 12})


@pytest.mark.parametrize(("path", "words"), [
    ("../step00", "steps[0].path leads out of the capture's folder"), ("/etc", "steps[0].path leads out of the capture's folder"),
    ("nothing", "nothing/capture.json"),
])
def test_sequences_that_cannot_be(server, client, files, path, words):
    named = json.dumps({"schema": "relit.sequence/1", "steps": [{"path": path}]}).encode()
    found = upload(server, client, {name: files[name] for name in files if name.startswith("step00")} | {"sequence.json": named}, "refused")
    assert words in found["problem"]
