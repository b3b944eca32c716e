"""relit submit, relit jobs and what relit capture sends, against a real service."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx2
import numpy as np
import pytest

from service.client import Client
from service.requests.relight import RelightOptions
from tests.scenes.captures import make_scene, write_capture, write_exr, write_radiance
from tests.service.acquisition.test_acquire import LAMPS, controller, request
from tests.service.acquisition.test_acquire import stage as stage
from tests.service.client.conftest import OWL, SKY, Between


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch, server, key):
    monkeypatch.setenv("RELIT_SERVER", f"{server.url}/v1")
    monkeypatch.setenv("RELIT_KEY", key)


def said(out: str) -> dict[str, str]:
    """Lines of `name  value`."""
    return {line.partition(" ")[0]: line.partition(" ")[2].strip() for line in out.splitlines()}


@pytest.mark.long
def test_what_is_imported_is_sent_without_what_lies_beside_it(relit, tmp_path: Path):
    folder, scene = tmp_path / "dome", make_scene(lights=5)
    for number, image in enumerate(scene.images):
        write_exr(folder / f"{number}.exr", image)
    table = "\n".join(f"{number}.exr {x:.9f} {y:.9f} {z:.9f}" for number, (x, y, z) in enumerate(scene.directions))
    (folder / "dome.lp").write_text(f"{len(scene.images)}\n{table}\n")
    (folder / "clip.bin").write_bytes(b"0" * 1_000_000)
    before = {path.name for path in folder.iterdir()}
    found = said(relit("import", "auto", folder, "--to", os.environ["RELIT_SERVER"]).well())
    assert {path.name for path in folder.iterdir()} == before
    with Client(os.environ["RELIT_SERVER"], os.environ["RELIT_KEY"]) as asking:
        capture = asking.captures.get(found["sent"])
    assert (capture.name, capture.state) == ("dome", "ready")
    kept = relit("import", "auto", folder, tmp_path / "kept" / "dome", "--to", os.environ["RELIT_SERVER"])
    assert said(kept.well())["sent"] == found["sent"]  # the same files under the same name are one capture
    assert {path.name for path in (tmp_path / "kept" / "dome").iterdir()} == {"capture.json", *(f"{number}.exr" for number in range(5))}


@pytest.mark.long
def test_a_folder_becomes_maps_frames_and_an_asset(relit, tmp_path: Path):
    found = said(relit(
        "submit", "pipeline", write_capture(tmp_path / "ball"), "--environment", SKY, "--method", "lambert", "--frames", "1-2",
        "--spin-degrees", "360", "--exposure", "-1", "--compression", "piz", "--name", "marble", "--format", "usda", "--job-name", "first",
        "--out", tmp_path / "out").well())
    assert found["state"].startswith("succeeded, ")
    assert {"maps.exr", "report.json", "asset.usda", "frame.0001.exr", "frame.0002.exr"} <= {
        path.name for path in (tmp_path / "out").iterdir()}
    with Client(os.environ["RELIT_SERVER"], os.environ["RELIT_KEY"]) as asking:
        request = asking.jobs.get(found["job"]).request
    assert (request.name, request.format, request.export.name, request.solve.method) == ("first", "usda", "marble", "lambert")
    assert request.relight == RelightOptions(frames="1-2", spin_degrees=360, exposure=-1, compression="piz")
    again = said(relit("submit", "shade", found["job"], "--light", "0,0,50,900,900,900", "--turn-degrees", "15").well())
    assert relit("jobs", "wait", again["job"], "--out", tmp_path / "shaded").code == 0
    assert (tmp_path / "shaded" / "picture.exr").is_file()
    exported = said(relit("submit", "export", found["job"], "--wait").well())
    assert "asset.usdz" in relit("jobs", "results", exported["job"]).out


@pytest.mark.long
def test_sources_of_all_three_kinds(relit, dome: str, sky: str, tmp_path: Path):
    registered = relit("submit", "relight", f"server:{OWL}", "--environment", f"server:{SKY}", "--wait").well()
    assert said(registered)["capture"].startswith("cap_")
    named = relit("submit", "relight", dome, "--environment", sky, "--wait", "--priority", "60").well()
    assert "capture" not in said(named)
    shown = said(relit("jobs", "show", said(named)["job"]).well())
    assert shown["kind"] == "relight" and "priority 60" in shown["state"]
    one, other = [said(relit("submit", "solve", write_capture(tmp_path / place / "ball"), "--method", "lambert").out)["capture"]
                  for place in ("here", "there")]
    assert one == other


@pytest.mark.long
def test_warnings_of_what_a_job_has_made_are_told(relit, dome: str, tmp_path: Path):
    """Frames have no report: of an environment that is not taken as its header says, nobody heard. Done again, it is said once."""
    sky = write_radiance(tmp_path / "sky.hdr", np.full((16, 32, 3), 0.5), "GAMMA=2.2")
    done = relit("submit", "relight", dome, "--environment", sky, "--frames", "1-30", "--wait").well()
    assert done.count("\nwarning     environment sky.hdr: its header says GAMMA=2.2") == 1
    with Client(os.environ["RELIT_SERVER"], os.environ["RELIT_KEY"]) as asking:
        log = asking.jobs.log(said(done)["job"])
    assert [f"warning: {each}" for each in log.warnings] == [each.text for each in log.entries if "warning" in each.text]


@pytest.mark.long
def test_images_and_captures_that_are_several(relit, tmp_path: Path):
    capture = write_capture(tmp_path / "ball")
    for name in ("d0.exr", "d1.exr"):
        write_exr(capture / name, np.full((16, 16, 3), 0.01))
    sent = said(relit("submit", "calibrate-dark", capture, "d0.exr", "d1.exr", "--out", tmp_path / "out").well())["capture"]
    assert (tmp_path / "out" / "dark.exr").is_file()
    assert json.loads((tmp_path / "out" / "capture.json").read_text())["dark"] == "dark.exr"
    other = write_capture(tmp_path / "other", make_scene(16, 5))
    done = relit("submit", "calibrate-procam", capture, other, sent, "--apply-to", other, "--board", "9x6",
                 "--square-m", "0.03", "--projector", "64x48", "--wait")
    assert done.code == 1 and "no column code" in done.err  # the captures are of lights: all were sent and read
    assert [line.split()[0] for line in done.out.splitlines()].count("capture") == 3
    assert relit("submit", "calibrate-procam", tmp_path / "none", "--board", "9", "--square-m", "0.03").code == 2


@pytest.mark.long
def test_light_keys_go_with_the_job_and_one_that_fails_is_one_sentence(relit, dome: str, tmp_path: Path):
    keys = tmp_path / "keys.json"
    keys.write_text('{"schema": "relit.keys/1", "captured": [{"image": "000.exr", "keys": [{"frame": 1, "weight": 1}]}]}')
    assert relit("submit", "relight", dome, "--keys", keys, "--wait").code == 0
    keys.write_text('{"schema": "relit.keys/1", "captured": [{"image": "missing.exr", "keys": [{"frame": 1, "weight": 1}]}]}')
    failed = relit("submit", "relight", dome, "--keys", keys, "--wait")
    assert failed.code == 1
    assert "missing.exr" in failed.err
    keys.write_text('{"schema": "relit.keys/1", "wrong": 1}')
    assert relit("submit", "relight", dome, "--keys", keys).code == 2
    done = relit("submit", "solve", dome, "--method", "gradient", "--wait")
    assert done.code == 1
    assert done.err.startswith("relit: ")
    assert len(done.err.splitlines()) == 1
    job = said(done.out)["job"]
    assert said(relit("jobs", "show", job).out)["error"] == done.err.removeprefix("relit: ").strip()
    assert "attempt 2" in said(relit("jobs", "retry", job).out)["state"]
    assert relit("jobs", "wait", job).code == 1
    assert job in relit("jobs", "list").out


@pytest.mark.long
@pytest.mark.parametrize(("arguments", "sentence"), [
    (["solve", "missing"], "missing: there is no such file or folder"),
    (["solve", "cap_0123456789abcdefghjk"], "cap_0123456789abcdefghjk"),
    (["solve", "server:/elsewhere"], "folder: "),
    (["solve", str(OWL / "capture.json")], "owl/capture.json: is a file: give the folder of the capture"),
    (["relight", str(OWL), "--environment", str(OWL)], "owl: is a folder: an environment is one lat-long .exr or .hdr"),
    (["export", "no-job"], 'JOB: is "no-job": give an identifier as the service printed it, which begins with job_'),
    (["relight", str(OWL), "--exposure", "99"], "exposure: "),
    (["relight", str(OWL), "--weights", "other"], "'--weights'"),
    (["relight", str(OWL), "--frames", "9-1"], "runs backwards"),
    (["relight", str(OWL)], "nothing lights the frames"),
    (["solve", str(OWL), "--priority", "101"], "priority: is 101: input should be less than or equal to 100"),
    (["solve", str(OWL), "--job-name", "two\nlines"], "name: "),
    (["solve", str(OWL), "--server", "nowhere"], "nowhere: is no URL of a service"),
    (["solve", str(OWL), "--out", f"{SKY}/out"], "cannot make "),
    (["solve", str(OWL), "--key", "key_wrong.wrong"], "give a key that is valid")])
def test_bad_input_is_one_sentence_and_exit_code_2(relit, arguments, sentence):
    relit("submit", *arguments).refused(sentence, printed=sentence == "nothing lights the frames")


def interrupted(*arguments: str) -> tuple[str, subprocess.CompletedProcess[str]]:
    """The job, and the program, ended by SIGINT while it waits; it was started without this signal, as a shell starts what ends with &."""
    program = [sys.executable, "-m", "service.cli.main", "submit", "relight", *arguments, "--frames", "1-300", "--wait"]
    process = subprocess.Popen(["sh", "-c", 'trap "" INT; exec "$0" "$@"', *program], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                               text=True)
    assert process.stdout is not None
    line = process.stdout.readline()
    time.sleep(1)  # until it waits; were it earlier, it would end all the same
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    return said(line)["job"], subprocess.CompletedProcess(process.args, process.returncode, out, err)


@pytest.mark.long
@pytest.mark.parametrize("option", [[], ["--cancel-on-interrupt"]], ids=["left running", "cancelled"])
def test_ctrl_c_leaves_the_job_running_unless_it_is_to_be_cancelled(relit, dome: str, sky: str, option):
    job, done = interrupted(dome, "--environment", sky, *option)
    assert done.returncode == 130
    (line,) = done.stderr.splitlines()
    with Client(os.environ["RELIT_SERVER"], os.environ["RELIT_KEY"]) as asking:
        state = asking.jobs.get(job).state
    if option:
        assert (line, state) == (f"relit: interrupted; {job} is cancelled", "cancelled")
        return
    assert line.startswith("relit: interrupted; ") and f"relit jobs wait {job}" in line and f"relit jobs cancel {job}" in line
    assert state in ("queued", "running")
    assert said(relit("jobs", "cancel", job).out)["state"].startswith("cancelled")
    assert "attempt 2" in said(relit("jobs", "resume", job).out)["state"]
    assert relit("jobs", "cancel", job).code == 0


@pytest.fixture
def capture(relit, tmp_path, stage, server, key, monkeypatch):
    """A function that runs the command with further options."""
    monkeypatch.setenv("RELIT_KEY", key)
    with controller(tmp_path, stage) as (rig, _):
        given = request(tmp_path, stage, rig)

        def run(*options, to=server.url):
            return relit("capture", given.plan, "--rig", rig, "--camera", given.camera, "--trigger", "shoot", "--out", given.out,
                         "--timeout", "5", "--to", to, *options)
        yield run


def identifier(out: str) -> str:
    return next(line.split()[1].rstrip(",") for line in out.splitlines() if line.startswith("sent "))


@pytest.mark.long
def test_pictures_are_sent_as_they_are_taken_and_the_capture_is_whole_after_the_last(capture, stage, tmp_path, client, monkeypatch):
    made, between = [], Between()  # the command's own network
    monkeypatch.setattr("service.cli.sending.Client", lambda url, key, **more: Client(url, key, transport=between, **more))
    release = stage.release

    def noted() -> None:
        made.append(len([path for path in between.sent("POST") if path.endswith("/files")]))
        release()
    stage.release = noted
    out = capture().well()
    found = client.captures.get(identifier(out))
    assert found.state == "ready" and found.name == "capture" and found.facts["frames"] == LAMPS + 1
    assert made[-1] >= 1  # some were sent before the last was taken
    validated = [path for path in between.sent("POST") if path.endswith("/validate")]
    assert len(validated) == 1
    again = capture().well()  # nothing is taken, and nothing sent
    assert identifier(again) == found.id and len(between.sent("PATCH")) == LAMPS + 2
    other = identifier(capture("--retake", "0003_light_002").well())
    assert other != found.id and client.captures.get(other).state == "ready"


@pytest.mark.long
def test_a_capture_that_was_cut_off_goes_on_with_its_upload(capture, stage, client):
    release = stage.release

    def breaks() -> None:
        if stage.released == 3:
            raise OSError("unplugged")
        release()
    stage.release = breaks
    with pytest.raises(OSError, match="unplugged"):
        capture()
    receiving = [found.id for found in client.captures.all() if found.state == "receiving"]
    stage.release = release
    assert identifier(capture().well()) in receiving


def test_a_service_that_is_not_there_is_said_before_a_lamp_is_on(capture, stage, monkeypatch, tmp_path):
    monkeypatch.setattr("service.cli.sending.Client", lambda url, key, **more: Client(url, key, patience_s=0.3, **more))
    said = capture(to="http://127.0.0.1:9").err.splitlines()
    assert "asked again for 0 s" in said[0] and "--to http://127.0.0.1:9: " in said[-1]  # at once, and when the patience is over
    capture(to="nowhere").refused("--to nowhere: nowhere: is no URL of a service")
    assert stage.released == 0 and stage.on == set()
    monkeypatch.setenv("RELIT_KEY", "wrong")
    capture().refused("--to ")
    assert stage.released == 0


@pytest.mark.long
def test_a_service_that_is_lost_ends_no_capture(capture, stage, tmp_path, client, monkeypatch):
    """All pictures are taken; the sentence says what is left, and the same command sends it."""
    between = Between()

    def lost(sent, send):
        if sent.method == "PATCH":
            raise httpx2.ConnectError("unplugged")
        return send()
    between.breaks = lost
    monkeypatch.setattr("service.cli.sending.Client", lambda url, key, **more: Client(url, key, patience_s=0.1, transport=between, **more))
    outcome = capture()
    assert outcome.code == 2 and "whole here: run the same command again to send the rest" in outcome.err
    assert len(list((tmp_path / "capture").glob("*.exr"))) == LAMPS + 1
    between.inner, between.breaks = httpx2.HTTPTransport(), lambda sent, send: send()  # the client has closed the one before
    assert client.captures.get(identifier(capture().well())).facts["frames"] == LAMPS + 1
    assert np.unique([path.suffix for path in (tmp_path / "capture").glob("0*")]).tolist() == [".exr"]
