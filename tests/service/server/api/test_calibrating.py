"""Jobs that calibrate: their results are those of the commands, byte by byte, and captures stay as they are."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from service.calibrate.chart import calibrate_chart
from service.calibrate.laser_planes import laser_planes
from service.calibrate.procam import procam
from service.calibrate.response import response
from service.calibrate.sensor import dark, flat_field, saturation, white_balance
from service.calibrate.tof import calibrate_tof
from service.requests import calibrate as requests
from service.requests.chart import ChartRequest
from tests.reference import tof
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_exr
from tests.scenes.chart import CAMERA, Pose, picture, reflectances, shoot, table
from tests.service.calibrate import test_rig as lamps
from tests.service.calibrate.solvers import test_procam as boards
from tests.service.calibrate.test_calibrate_tof import cw, sweep
from tests.service.calibrate.test_laser_planes import boards as laser_boards
from tests.service.calibrate.test_procam import write_view
from tests.service.depth.tof.test_tof import pulsed_frames
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import admitted, error_of, finish, finished, made_by, refused, report_of, result, submit
from tests.service.server.api.test_measuring import files_of, upload

LEVELS = np.linspace(0, 1, 5).tolist()
DARKS, WHITES = ["dark0.exr", "dark1.exr"], ["cards/white0.exr", "cards/white1.exr"]
GREYS = [f"grey{number}.exr" for number in range(len(LEVELS))]
BOARD = {"board": "9x6", "square_m": 0.03, "projector": "256x192"}


def sent(server, client, folder: Path) -> str:
    """The identifier of a folder, uploaded with all its files."""
    return upload(server, client, files_of(folder))["id"]


def compare(client, job: dict, made: Path, names: dict[str, str], places: dict[Path, str]) -> None:
    """Compare results with the files that a command made: `names` gives the file of the command for each result."""
    assert made_by(client, job) == set(names)
    for name, there in names.items():
        found = result(client, job, name)
        wanted = (made / there).read_bytes()
        for folder, identifier in places.items():  # a service does not say where its folders lie
            wanted = wanted.replace(str(folder).encode(), identifier.encode())
        assert found == wanted, name


def same(found, wanted) -> None:
    """Compare what two fits wrote: LAPACK adds in an order that depends on where arrays lie in memory, by 1e-12 in a focal length."""
    if isinstance(wanted, dict | list):
        assert type(found) is type(wanted) and len(found) == len(wanted)
        for key in wanted if isinstance(wanted, dict) else range(len(wanted)):
            same(found[key], wanted[key])
    else:
        assert found == (pytest.approx(wanted, rel=1e-6, abs=1e-9) if isinstance(wanted, float) else wanted)


@pytest.fixture(scope="module")
def sensor(tmp_path_factory):
    """A capture with saturated readings, dark images, white cards and a projector's greys in its folder."""
    scene = make_scene(32, 4)
    folder = write_capture(tmp_path_factory.mktemp("sensor") / "cap", scene._replace(images=np.minimum(scene.images, 0.15)))
    ramp = np.linspace(0.5, 1, 32)[None, :, None] * np.ones((32, 32, 3))
    for number in range(2):
        write_exr(folder / f"dark{number}.exr", np.full((32, 32, 3), 0.001 * (1 + number)))
        write_exr(folder / "cards" / f"white{number}.exr", (0.6 + 0.1 * number) * ramp)
    for number, level in enumerate(LEVELS):
        write_exr(folder / f"grey{number}.exr", 0.01 + 0.1 * ramp * level**2.2)
    projector = {"resolution": [64, 48], "focal_px": [60, 60], "camera_from_projector": np.eye(4).tolist()}
    edit_manifest(folder, projector=projector)
    return folder


@pytest.fixture(scope="module")
def uploaded(server, client, sensor):
    return sent(server, client, sensor)


KINDS = {  # the product, its request, the fields of the job, and the file that it makes beside the manifest and the report
    "dark": (dark, requests.DarkRequest, {"images": DARKS}, "dark.exr"),
    "flat-field": (flat_field, requests.FlatFieldRequest, {"images": WHITES, "dark_images": DARKS[:1]}, "flat.exr"),
    "white-balance": (white_balance, requests.WhiteBalanceRequest, {"images": WHITES[:1], "options": {"region": [4, 0, 8, 16]}}, None),
    "saturation": (saturation, requests.SaturationRequest, {}, None),
    "response": (response, requests.ResponseRequest, {"images": GREYS, "options": {"levels": LEVELS}}, None),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_results_are_those_of_the_command(server, client, sensor, uploaded, tmp_path, kind):
    product, model, fields, made = KINDS[kind]
    here = Path(shutil.copytree(sensor, tmp_path / "cap"))
    given = {name: tuple(here / each for each in value) for name, value in fields.items() if name != "options"} | fields.get("options", {})
    product(model(capture=here, **given, **({"write": True} if kind == "saturation" else {})))
    job = finished(server, client, kind=f"calibrate-{kind}", capture=uploaded, **fields)
    compare(client, job, here, {name: name for name in ("capture.json", "calibration.json", made) if name}, {here: uploaded})


@pytest.mark.long
def test_the_colours_of_a_chart(server, client, tmp_path):
    here = shoot(tmp_path / "cap", [np.maximum(picture(0.5 * reflectances() @ CAMERA.T, Pose(10, 5), size=(320, 240)).pixels, 0)])
    (here / "chart.csv").write_text("name,r,g,b\n" + "\n".join(
        f"{row['name']},{r},{g},{b}" for row, (r, g, b) in zip(table(), reflectances(), strict=True)))
    uploaded = sent(server, client, here)
    calibrate_chart(ChartRequest(capture=here, reflectances=here / "chart.csv"))
    job = finished(server, client, kind="calibrate-chart", capture=uploaded, reflectances="chart.csv")
    compare(client, job, here, {name: name for name in ("capture.json", "calibration.json", "chart.png")}, {here: uploaded})


@pytest.mark.long
def test_the_time_of_flight_of_a_sweep(server, client, tmp_path):
    steps = [(f"d{k}", depth, 0.05 + 0.01 * depth, None) for k, depth in enumerate((1.0, 8.0))]
    path = sweep(tmp_path / "sweep", steps, lambda view: pulsed_frames(tof.histogram(view, 1e6, seed=0)))
    calibrate_tof(requests.TofCalibrationRequest(sweep=path, out=tmp_path / "tof.json", device="cpu"))
    uploaded = sent(server, client, path.parent)
    job = finished(server, client, kind="calibrate-tof", capture=uploaded)
    compare(client, job, tmp_path, {name: name for name in ("tof.json", "calibration.json")}, {path.parent: uploaded})


@pytest.mark.long
def test_a_sweep_of_another_capture(server, client, tmp_path):
    """What it names beside its own captures may be of another project."""
    path = sweep(tmp_path / "sweep", [(f"d{k}", 1.0 + k, 0.0, None) for k in range(2)], cw)
    other, data = sent(server, client, path.parent), json.loads(path.read_text())
    for away in ("/etc", f"d0/../../{other}/d0"):
        data["steps"][1]["capture"] = away
        path.write_text(json.dumps(data))
        assert "is none of the captures" in error_of(server, client, kind="calibrate-tof", capture=sent(server, client, path.parent))
    assert "sweep: '../sweep.json' leads out" in error_of(server, client, kind="calibrate-tof", capture=other, sweep="../sweep.json")


def calibrated(server, client, job: dict, ids: list[str], folders: list[Path]) -> dict:
    """Compare the manifests of a job with those that the command wrote into folders, and return what was measured."""
    assert made_by(client, job) == {"calibration.json", *(f"{identifier}.capture.json" for identifier in ids)}
    for identifier, folder in zip(ids, folders, strict=True):
        found = report_of(server, client, job, f"{identifier}.capture.json")
        same(found, json.loads((folder / "capture.json").read_text()))
    return report_of(server, client, job, "calibration.json")


@pytest.mark.long
def test_a_rig_from_registered_poses(server, client, registered, tmp_path):
    ids, folders = [], []
    for number, pose in enumerate(boards.poses(4)):
        folder = registered / f"pose{number}"
        write_view(folder, pose)
        folders.append(Path(shutil.copytree(folder, tmp_path / folder.name)))
        ids.append(admitted(server, client, folder)["id"])
    before = {path: path.read_bytes() for path in registered.glob("pose*/*.json")}
    job = submit(client, kind="calibrate-procam", captures=ids[:3], apply_to=ids[3:], options=BOARD)
    request = client.get(f"/v1/jobs/{job['id']}").json()["request"]
    assert request["options"]["board"] == [9, 6] and request["captures"] == ids[:3]
    finish(server, client, job)
    result = procam(requests.ProcamRequest(captures=tuple(folders[:3]), apply_to=tuple(folders[3:]), device="cpu", **BOARD))
    log = client.get(f"/v1/jobs/{job['id']}/log").json()["entries"]
    assert [entry["text"] for entry in log if entry["text"].startswith("warning: ")] == [f"warning: {said}" for said in result.warnings]
    report = calibrated(server, client, job, ids, folders)["procam"]
    assert report["captures"] == [view["view"] for view in report["views"]] == ids[:3]
    assert report["options"]["apply_to"] == ids[3:]
    assert before == {path: path.read_bytes() for path in registered.glob("pose*/*.json")}
    assert client.delete(f"/v1/captures/{ids[1]}").status_code in (204, 409)  # whichever it is, the results stay
    assert client.get(f"/v1/jobs/{job['id']}/results/{ids[1]}.capture.json").status_code == 200


@pytest.mark.long
def test_the_planes_of_a_laser(server, client, tmp_path):
    folders = laser_boards(tmp_path)
    ids = [sent(server, client, folder) for folder in folders]
    board = {"board": "x".join(map(str, boards.BOARD)), "square_m": boards.SQUARE}
    job = finished(server, client, kind="calibrate-laser-planes", captures=ids[:3], apply_to=ids[3:], options=board)
    laser_planes(requests.LaserPlanesRequest(captures=tuple(folders[:3]), apply_to=tuple(folders[3:]), device="cpu", **board))
    report = calibrated(server, client, job, ids, folders)["laser-planes"]
    assert [board["capture"] for board in report["boards"]] == ids[:3]


@pytest.mark.parametrize(("fields", "words"), [
    ({"kind": "calibrate-dark"}, "images"), ({"kind": "calibrate-dark", "images": []}, "images"),
    ({"kind": "calibrate-dark", "images": ["a\0b"]}, "images"),
    ({"kind": "calibrate-response", "images": ["a.exr", "b.exr"]}, "images"),
    ({"kind": "calibrate-response", "images": GREYS, "options": {"levels": [0, 2]}}, "levels"),
    ({"captures": []}, "captures"), ({"captures": ["cap_x"]}, "captures"), ({"captures": None}, "captures"),
    ({"options": {"square_m": 0.03}}, "board"), ({"options": {"board": [9], "square_m": 0.03}}, "board"),
    ({"options": {"board": "9", "square_m": 0.03}}, "board"), ({"options": {"board": "9x6", "square_m": 75}}, "square"),
])
def test_requests_that_are_refused(client, fields, words):
    some = f"cap_{'0' * 20}"
    good = {"capture": some} if "kind" in fields else {"kind": "calibrate-procam", "captures": [some], "options": BOARD}
    answer = client.post("/v1/jobs", json=good | fields)
    refused(answer, 422, "")
    assert words in answer.text


@pytest.mark.long
def test_images_or_a_ball_that_are_not_there(server, client, uploaded, dome):
    for kind, names in (("dark", ["none.exr"]), ("dark", ["../x.exr"]), ("flat-field", ["/etc/passwd"])):
        error = error_of(server, client, kind=f"calibrate-{kind}", capture=uploaded, images=names)
        assert error.startswith(f"images: {names[0]!r} ")
    assert "--levels: has 2 values, there are 5 images" in error_of(
        server, client, kind="calibrate-response", capture=uploaded, images=GREYS, options={"levels": [0, 1]})
    missing = client.post("/v1/jobs", json={"kind": "calibrate-procam", "captures": [f"cap_{'0' * 20}"], "options": BOARD})
    refused(missing, 404, "captures: cap_00000000000000000000 is not in this project")
    assert "ball" in error_of(server, client, kind="calibrate-mirror-ball", capture=dome)
    assert "leads out of the capture's folder" in error_of(server, client, kind="calibrate-grey-ball", capture=dome, masks=["../../x.png"])


@pytest.mark.long
def test_the_brightness_of_lights(server, client, dome):
    job = finished(server, client, kind="calibrate-intensity", capture=dome, options={"pixels": 100})
    assert made_by(client, job) == {"capture.json", "calibration.json"}
    measured = report_of(server, client, job, "calibration.json")["intensity"]
    assert len(measured["lights"]) == len(report_of(server, client, job, "capture.json")["frames"])
    assert str(SAMPLES) not in json.dumps(measured)
    assert measured["options"]["capture"] == measured["capture"] == dome


@pytest.mark.long
def test_the_lamps_of_a_rig_are_measured_by_a_job(server, client, relit, tmp_path):
    stage = lamps.make_stage(1, 8)
    rig = lamps.nominal(tmp_path, stage)
    cues, table = lamps.swept(relit, rig, "--levels", 3)
    capture = lamps.shoot(tmp_path / "capture", stage, lamps.grey_ball(stage), cues)
    shutil.copy(table, capture / "cues.csv")
    identifier = sent(server, client, capture)
    (u, v, radius), options = map(float, lamps.CIRCLE.split(",")), {"albedo": [lamps.ALBEDO] * 3}
    job = finished(server, client, kind="calibrate-rig", capture=identifier, rig=json.loads(rig.read_text()), table="cues.csv",
               options={"circles": [{"u": u, "v": v, "radius_px": radius}], **options})
    assert made_by(client, job) == {"rig.json", "measured.json", "calibration.json"}
    relit.done("calibrate", "rig", capture, rig, "--table", table, "--ball", lamps.CIRCLE, "--albedo", lamps.ALBEDO,
               "--out", tmp_path / "measured.json")
    found = report_of(server, client, job, "measured.json")
    same(found, json.loads((tmp_path / "measured.json").read_text()))
