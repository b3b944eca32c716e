"""relit capture --to: pictures go to a service as they are taken, and the capture is whole there after the last."""

import httpx2
import numpy as np
import pytest

from service.client import Client
from tests.service.acquisition.test_acquire import LAMPS, controller, request
from tests.service.acquisition.test_acquire import stage as stage  # a fixture
from tests.service.client.conftest import Between


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


def test_pictures_are_sent_as_they_are_taken_and_the_capture_is_whole_after_the_last(capture, stage, tmp_path, client, monkeypatch):
    made, between = [], Between()  # the command's own network
    monkeypatch.setattr("service.cli.sending.Client", lambda url, key: Client(url, key, transport=between))
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
    monkeypatch.setattr("service.cli.sending.Client", lambda url, key: Client(url, key, patience_s=0.1))
    capture(to="http://127.0.0.1:9").refused("--to http://127.0.0.1:9: ")
    capture(to="nowhere").refused("--to nowhere: nowhere: is no URL of a service")
    assert stage.released == 0 and stage.on == set()
    monkeypatch.setenv("RELIT_KEY", "wrong")
    capture().refused("--to ")
    assert stage.released == 0


def test_a_service_that_is_lost_ends_no_capture(capture, stage, tmp_path, client, monkeypatch):
    """All pictures are taken; the sentence says what is left, and the same command sends it."""
    between = Between()

    def lost(sent, send):
        if sent.method == "PATCH":
            raise httpx2.ConnectError("unplugged")
        return send()
    between.breaks = lost
    monkeypatch.setattr("service.cli.sending.Client", lambda url, key: Client(url, key, patience_s=0.1, transport=between))
    outcome = capture()
    assert outcome.code == 2 and "the capture is whole here: run the same command again to send the rest" in outcome.err
    assert len(list((tmp_path / "capture").glob("*.exr"))) == LAMPS + 1
    between.inner, between.breaks = httpx2.HTTPTransport(), lambda sent, send: send()  # the client has closed the one before
    assert client.captures.get(identifier(capture().well())).facts["frames"] == LAMPS + 1
    assert np.unique([path.suffix for path in (tmp_path / "capture").glob("0*")]).tolist() == [".exr"]
