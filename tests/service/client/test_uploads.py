"""Files in: whole, once, and gone on with after a break."""

import os
import threading
from collections.abc import Callable
from pathlib import Path

import httpx2
import numpy as np
import pytest

from service.client import Client, ClientError, FileError, IntakeRefused, Invalid, NotFound
from service.client.local_files import files_of
from tests.scenes.captures import edit_manifest, files_in, write_capture, write_exr
from tests.service.client.conftest import OWL, SKY, Between, Cut, lose
from tests.service.server_process import Server

Send = Callable[[], httpx2.Response]
CUT = 1_500_000
"""Bytes after which a body is cut, of the 4.5 MB that `big` has."""


@pytest.fixture(scope="session")
def big(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment of noise, which no compression makes small."""
    pixels = np.random.default_rng(0).uniform(size=(512, 1024, 3)).astype(np.float32)
    return write_exr(tmp_path_factory.mktemp("sky") / "noise.exr", pixels)


def kept(server: Server, identifier: str) -> Path:
    kind = {"cap": "captures", "env": "environments"}[identifier.partition("_")[0]]
    return server.data / "projects" / "owls" / kind / identifier


def assert_equal_files(here: Path, there: Path) -> None:
    assert files_in(there) == {name for name in files_in(here) if not any(part.startswith(".") for part in Path(name).parts)}
    for name in files_in(there):
        assert (here / name).read_bytes() == (there / name).read_bytes(), name


@pytest.mark.long
def test_a_capture_is_sent_once(client: Client, server: Server, between: Between, tmp_path: Path):
    capture = write_capture(tmp_path / "ball")
    (capture / ".relit").mkdir()
    (capture / ".relit" / "stack.npy").write_bytes(b"a cache")
    first = client.captures.upload(capture)
    assert (first.name, first.state, first.registered) == ("ball", "ready", False)
    assert_equal_files(capture, kept(server, first.id))
    assert ".relit/stack.npy" in files_in(capture)
    between.requests.clear()
    assert client.captures.upload(capture).id == first.id
    assert [request.method for request in between.requests] == ["POST"]
    assert client.captures.upload(capture, name="another").id != first.id
    edit_manifest(capture, name="changed")
    assert client.captures.upload(capture).id != first.id
    made = []
    for _ in range(2):
        made.append(client.captures.upload(capture, name="deleted").id)
        client.captures.delete(made[-1])
        with pytest.raises(NotFound):
            client.captures.get(made[-1])
    assert made[0] != made[1]


@pytest.mark.long
def test_a_sequence_keeps_its_folders_and_what_lies_on_the_server_is_registered(client: Client, server: Server, tmp_path: Path):
    for step in ("001", "002"):
        write_capture(tmp_path / "walk" / step)
    made = client.captures.upload(tmp_path / "walk")
    assert made.facts is not None and made.facts["captures"] == 2
    assert_equal_files(tmp_path / "walk", kept(server, made.id))
    made = client.captures.register(f"{OWL}/")
    assert (made.name, made.state, made.registered) == ("owl", "ready", True)
    assert client.environments.register(str(SKY)).name == "environment.exr"
    assert made.id in [one.id for one in client.captures.all()]
    with pytest.raises(Invalid, match="folder: "):
        client.captures.register(str(server.data))


@pytest.mark.long
@pytest.mark.parametrize("error", [httpx2.WriteError, httpx2.ReadTimeout])
def test_a_broken_upload_is_gone_on_with(client: Client, server: Server, between: Between, big: Path, error):
    offsets = []

    def breaks(request: httpx2.Request, send: Send) -> httpx2.Response:
        if request.method == "PATCH":
            offsets.append(int(request.headers["upload-offset"]))
            if len(offsets) < 3:
                request.stream = Cut(request.stream, CUT, error)
        return send()

    between.breaks = breaks
    made = client.environments.upload(big, name=f"broken {error.__name__}")
    assert_equal_files(big.parent, kept(server, made.id))
    assert len(offsets) == 3
    assert 0 == offsets[0] < offsets[1] < offsets[2] < big.stat().st_size


def test_answers_that_are_lost_make_nothing_twice(client: Client, server: Server, between: Between, big: Path):
    lost = set()

    def breaks(request: httpx2.Request, send: Send) -> httpx2.Response:
        answer = send()
        what = request.method, request.url.path.rpartition("/")[2]
        if request.method != "GET" and what not in lost:
            lost.add(what)
            lose(answer)
        return answer

    between.breaks = breaks
    made = client.environments.upload(big, name="lost")
    assert made.state == "ready"
    assert {what for method, what in lost if method == "POST"} == {"environments", "files", "validate"}
    assert {method for method, _ in lost} == {"POST", "PATCH", "HEAD"}
    assert len(between.sent("PATCH")) == 1  # all had come; the look at the offset told
    assert [one.id for one in client.environments.all() if one.name == "lost"] == [made.id]


def test_another_run_goes_on_where_one_was_broken_off(server: Server, key: str, big: Path):
    begun, taken = [], []

    def breaks(request: httpx2.Request, send: Send) -> httpx2.Response:
        if begun:
            raise httpx2.ConnectError("the network is gone")
        if request.method == "PATCH":
            begun.append(request)
            request.stream = Cut(request.stream, CUT, httpx2.WriteError)
        return send()

    def note(request: httpx2.Request, send: Send) -> httpx2.Response:
        answer = send()
        if request.method == "PATCH" and answer.is_success:  # refused with 409 as long as the server has not noticed the cut
            taken.append(int(request.headers["upload-offset"]))
        return answer

    for patience_s in (0, 30):
        between = Between()
        with Client(server.url, key, patience_s=patience_s, transport=between) as client:
            if patience_s == 0:
                between.breaks = breaks
                with pytest.raises(ClientError):
                    client.environments.upload(big, name="two runs")
            else:
                between.breaks = note
                assert client.environments.upload(big, name="two runs").state == "ready"
    assert len(taken) == 1
    assert taken[0] > 0


@pytest.mark.long
def test_one_failure_stops_the_other_files_and_a_capture_that_cannot_be_used_says_why(client: Client, between: Between, tmp_path: Path):
    capture = write_capture(tmp_path / "ball")
    refused = threading.Event()

    def breaks(request: httpx2.Request, send: Send) -> httpx2.Response:
        if request.method == "PATCH":
            refused.set()
            return httpx2.Response(507, headers={"Content-Type": "application/problem+json", "Retry-After": "600"},
                                   json={"type": "urn:relit:problem:full", "detail": "there is no space left"}, request=request)
        return send()

    between.breaks = breaks
    with pytest.raises(ClientError, match="there is no space left"):
        client.captures.upload(capture, name="full")
    assert refused.is_set()
    count = len(between.requests)
    between.breaks = lambda request, send: send()
    assert client.captures.upload(capture, name="full").state == "ready"
    assert len(between.requests) > count
    (capture / "000.exr").write_bytes(b"no image")
    for _ in range(2):  # sent again it is looked at again, and says so again
        with pytest.raises(IntakeRefused, match=r"ball .cap_.*000\.exr") as caught:
            client.captures.upload(capture)
        assert caught.value.intake.state == "refused"


def test_files_that_cannot_be_sent(client: Client, tmp_path: Path):
    with pytest.raises(FileError, match="missing: there is no such file or folder"):
        client.captures.upload(tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="empty: has no files"):
        client.captures.upload(tmp_path / "empty")
    (tmp_path / "empty" / "000.png").write_bytes(b"a photograph")
    with pytest.raises(FileError, match=r"empty: holds no capture\.json: relit import"):
        client.captures.upload(tmp_path / "empty")
    capture = write_capture(tmp_path / "ball")
    (capture / "more").symlink_to(tmp_path / "empty", target_is_directory=True)
    with pytest.raises(FileError, match="more: is a link to a folder"):
        client.captures.upload(capture)
    (capture / "more").unlink()
    (tmp_path / "secret.txt").write_text("a key")
    for target, sentence in ((tmp_path / "secret.txt", "notes.txt: is a link that leads out of"),
                             ("notes.txt", "notes.txt: is (a link|no file)"),  # from Python 3.13 on a circle of links can be followed
                             ("missing.txt", "notes.txt: is no file")):
        (capture / "notes.txt").symlink_to(target)
        with pytest.raises(FileError, match=sentence):
            client.captures.upload(capture)
        (capture / "notes.txt").unlink()
    os.mkfifo(capture / "pipe")  # reading it would wait for ever
    with pytest.raises(FileError, match="pipe: is no file"):
        client.captures.upload(capture)
    (capture / "pipe").unlink()
    (capture / "again.exr").symlink_to("000.exr")  # within the folder it is a file like others
    assert "again.exr" in [name for _, name in files_of(capture)]
