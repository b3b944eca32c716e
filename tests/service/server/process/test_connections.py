"""Connections: clients that send no whole request, or take no answer, give way, and the others are served."""

import os
import re
import resource
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

import httpx2
import pytest
import uvicorn
from anyio import to_thread

from service.requests.keys import Scope
from service.server.base.settings import Settings
from service.server.process import connections
from service.server.process.connections import ConnectionLimits, limits_of, raise_descriptors
from service.server.process.serve import THREADS, http_server
from tests.service.server_process import revoke, serving
from tests.service.waiting import until

WAIT_S = 20.0
HALF = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n"
WHOLE = HALF + b"\r\n"
LARGE = 64 << 20
"""Bytes of an answer that no buffer between two sockets takes."""


async def app(scope, receive, send) -> None:
    if scope["type"] != "http":
        return
    body = {"/large": b"x" * LARGE, "/threads": b"%d" % to_thread.current_default_thread_limiter().total_tokens}.get(
        scope["path"], scope["client"][0].encode())
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", str(len(body)).encode())]})
    for begin in range(0, len(body), 1 << 20):
        await send({"type": "http.response.body", "body": body[begin : begin + (1 << 20)], "more_body": begin + (1 << 20) < len(body)})


@contextmanager
def running(limits: ConnectionLimits, **settings) -> Iterator[tuple[int, uvicorn.Server]]:
    """The server of `relit serve` around another app, in a thread; its port."""
    listening = socket.create_server(("127.0.0.1", 0))
    server = http_server(app, Settings(**settings), limits)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    try:
        yield listening.getsockname()[1], server
    finally:
        server.should_exit = True
        thread.join(WAIT_S)


def opened(port: int, sent: bytes = b"", source: str = "127.0.0.1") -> socket.socket:
    made = socket.create_connection(("127.0.0.1", port), timeout=WAIT_S, source_address=(source, 0))
    made.sendall(sent)
    return made


def answered(port: int, source: str = "127.0.0.1", headers: bytes = b"") -> bytes:
    with opened(port, HALF + headers + b"Connection: close\r\n\r\n", source) as asking:
        return b"".join(iter(lambda: asking.recv(4096), b""))


def closed(connection: socket.socket) -> bool:
    """Whether the server closes a connection; if it does not, reading takes too long and raises."""
    with suppress(ConnectionResetError):
        while connection.recv(4096):
            pass
    return True


def test_requests_that_are_never_whole_give_way_to_those_that_are():
    with running(ConnectionLimits(20, 20)) as (port, server):
        half = [opened(port, HALF) for _ in range(60)]
        for _ in range(5):
            assert answered(port).startswith(b"HTTP/1.1 200")
        assert len(server.server_state.connections) <= 20
        assert all(closed(connection) for connection in half[:40])
        half[-1].sendall(b"\r\n")  # the youngest are still heard
        assert half[-1].recv(4096).startswith(b"HTTP/1.1 200")
        for connection in half:
            connection.close()


def test_a_header_has_to_come_in_time_however_slowly_its_bytes_come(monkeypatch):
    monkeypatch.setattr(connections, "HEADER_S", 0.5)
    with running(ConnectionLimits(20, 20)) as (port, _):
        silent, kept, trickling = opened(port), opened(port, WHOLE), opened(port, WHOLE)
        for connection in (kept, trickling):
            assert connection.recv(4096).startswith(b"HTTP/1.1 200")
        ended = False
        for letter in HALF * 3:  # an answered connection, whose next request comes byte by byte
            try:
                trickling.sendall(bytes([letter]))
            except OSError:
                ended = True
                break
            time.sleep(0.05)
        assert ended and closed(silent) and closed(kept)


def test_an_address_that_takes_its_share_leaves_the_rest_to_others():
    with running(ConnectionLimits(20, 5)) as (port, server):
        theirs = [opened(port, HALF, "127.0.0.2") for _ in range(30)]
        mine = opened(port, HALF, "127.0.0.1")
        assert answered(port, "127.0.0.2").startswith(b"HTTP/1.1 200")
        assert len(server.server_state.connections) <= 6 + 1
        mine.sendall(b"\r\n")
        assert mine.recv(4096).startswith(b"HTTP/1.1 200")  # it was older than theirs
        for connection in (mine, *theirs):
            connection.close()


@pytest.mark.long
def test_who_takes_no_answer_is_closed_and_who_is_busy_is_not(monkeypatch):
    monkeypatch.setattr(connections, "STALL_S", 5.0)  # so that a loaded machine asks a third time before the first two are closed
    monkeypatch.setattr(connections, "HEADER_S", 0.5)
    with running(ConnectionLimits(2, 2)) as (port, server):
        request = WHOLE.replace(b"/healthz", b"/large")
        stalled = [opened(port, request) for _ in range(2)]
        assert all(connection.recv(1) for connection in stalled)
        with suppress(ConnectionResetError):  # which may come before the answer, as the request is not read
            assert b"503" in answered(port)  # all are busy: none can be closed for it
        until(lambda: not server.server_state.connections, within_s=WAIT_S)
        reader, taken = opened(port, request), 0
        while taken < LARGE:  # for longer than a header may take
            piece = reader.recv(1 << 20)
            assert piece, f"closed after {taken} bytes"
            taken += len(piece)
            time.sleep(0.02)
        for connection in (reader, *stalled):
            connection.close()


def test_a_proxy_is_believed_where_it_is_named_alone_and_requests_wait_in_so_many_threads():
    forged = b"X-Forwarded-For: 10.9.8.7\r\n"
    with running(ConnectionLimits(20, 20)) as (port, _):
        assert answered(port, headers=forged).endswith(b"127.0.0.1")
    with running(ConnectionLimits(20, 20), trusted_proxies="127.0.0.0/24") as (port, _):
        assert answered(port, headers=forged).endswith(b"10.9.8.7")
    with running(ConnectionLimits(20, 20)) as (port, _):
        assert httpx2.get(f"http://127.0.0.1:{port}/threads", timeout=WAIT_S).content == b"%d" % THREADS


@pytest.mark.parametrize("descriptors", [64, 256, 1024, 4096, 20_000, 1 << 20])
def test_bounds_leave_descriptors_for_files(descriptors):
    limits = limits_of(Settings(), descriptors)
    assert limits.of_address <= limits.connections and limits.connections >= 16
    if descriptors > 512:
        assert limits.connections + connections.AT_ONCE + connections.OWN_DESCRIPTORS <= descriptors
    assert limits_of(Settings(max_connections=10, max_address_connections=3), 4096) == (10, 3)


def test_descriptors_are_raised_to_what_is_allowed():
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(512, before[1]), before[1]))
        assert raise_descriptors() == before[1] or before[1] == resource.RLIM_INFINITY
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (before[1], before[1])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.mark.long
def test_half_sent_requests_stop_no_service_of_1024_descriptors(tmp_path):
    """Before there were bounds, 1100 of them stopped it for as long as they stayed, and the log grew by megabytes a second."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(4096, hard)), hard))
    with serving(tmp_path, "--anonymous", "--device", "none", descriptors=1024) as server:
        port, logged = int(server.url.rpartition(":")[2]), server.log.stat().st_size
        half = [opened(port, HALF) for _ in range(1100)]
        for _ in range(20):
            assert httpx2.get(f"{server.url}/healthz", timeout=WAIT_S).status_code == 200
        assert len(os.listdir(f"/proc/{server.process.pid}/fd")) < 1024
        assert server.log.stat().st_size - logged < 100_000
        for connection in half:
            connection.close()


@pytest.mark.long
def test_a_key_has_its_streams_and_leaves_the_rest_to_others(tmp_path):
    """One read key opened 1003 streams within its rate limit, and other projects were not answered."""
    with serving(tmp_path, "--device", "none", max_streams="3", max_project_streams="5") as server, ExitStack() as stack:
        made = [server.key(project, Scope.READ) for project in ("larch", "larch", "birch")]
        port = int(server.url.rpartition(":")[2])

        def stream(key: str) -> tuple[int, socket.socket]:
            connection = opened(port, f"GET /v1/events HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {key}\r\n\r\n".encode())
            stack.enter_context(connection)
            return int(re.match(rb"HTTP/1.1 (\d+)", connection.recv(4096))[1]), connection

        first = [stream(made[0]) for _ in range(6)]
        assert [status for status, _ in first] == [200] * 3 + [429] * 3
        assert [stream(made[1])[0] for _ in range(4)] == [200] * 2 + [429] * 2
        assert stream(made[2])[0] == 200
        first[0][1].close()
        until(lambda: stream(made[0])[0] == 200)  # once the server has seen that it is closed


@pytest.mark.long
def test_the_stream_of_a_revoked_key_ends(tmp_path):
    with serving(tmp_path, "--device", "none") as server:
        revoked, kept = (server.key(scope=Scope.READ) for _ in range(2))
        with server.client(revoked) as one, server.client(kept) as two, server.database() as database:
            with one.stream("GET", "/v1/events") as ending, two.stream("GET", "/v1/events") as staying:
                assert ending.status_code == staying.status_code == 200
                assert revoke(database, revoked)
                assert list(ending.iter_lines()) == []
                assert not staying.is_closed
            assert one.get("/v1/events").status_code == 401
