"""Jobs waited for over a network that breaks, and what they made, fetched."""

import json
import random
from collections.abc import Callable
from pathlib import Path

import httpx2
import pytest

from service.client import Client, Conflict, FileError, JobEnded, NotFound, Unreachable
from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import RelightJob, SolveJob
from service.requests.relight import RelightOptions
from service.requests.solve import Method, SolveOptions
from tests.service.client.conftest import Between, Cut, lose
from tests.service.recording import Recording
from tests.service.server.api.job_calls import succeeded

Send = Callable[[], httpx2.Response]


@pytest.fixture(scope="session")
def results(server) -> Path:
    """The folder of the results of a job, which has its name: one of several megabytes, and small ones."""
    folder = succeeded(server, SolveJob(kind="solve", capture=new_id(CAPTURE)), "owls")
    for name, size in {"asset.usdz": 5 << 19, "frame.0001.exr": 1000, "frame.0002.exr": 1, "report.json": 0}.items():
        (folder / name).write_bytes(random.Random(name).randbytes(size))
    return folder


def frames(capture: str, environment: str, count: int, **common: object) -> RelightJob:
    return RelightJob(kind="relight", capture=capture, environment=environment, options=RelightOptions(frames=f"1-{count}"), **common)


@pytest.mark.long
def test_a_job_is_waited_for(client: Client, between: Between, dome: str, sky: str):
    told = Recording()
    job = client.jobs.submit(frames(dome, sky, 40, name="wait", priority=70))
    assert (job.state, job.priority, job.request.name) == ("queued", 70, "wait")
    ended = client.jobs.wait(job.id, progress=told)
    assert ended == client.jobs.get(job.id)
    assert ended.state == "succeeded"
    assert [stage.told[-1] for stage in told.stages if (stage.name, stage.total) == ("frames", 40)][-1] == 40
    assert [path for path in between.sent("GET") if path.endswith("/events")] == [f"/v1/jobs/{job.id}/events"]


@pytest.mark.long
def test_a_failed_job_says_why_and_can_be_tried_again(client: Client, dome: str):
    job = client.jobs.submit(SolveJob(kind="solve", capture=dome, options=SolveOptions(method=Method.GRADIENT)))
    with pytest.raises(JobEnded, match="gradient") as caught:
        client.jobs.wait(job.id)
    assert (caught.value.job.state, str(caught.value)) == ("failed", caught.value.job.error)
    assert client.jobs.retry(job.id).attempt == 2
    with pytest.raises(JobEnded):
        client.jobs.wait(job.id)
    with pytest.raises(Conflict, match="not cancelled"):
        client.jobs.resume(job.id)
    client.jobs.delete(job.id)
    with pytest.raises(NotFound):
        client.jobs.get(job.id)


@pytest.mark.long
def test_a_cancelled_job_ends_and_is_gone_on_with(client: Client, dome: str, sky: str):
    long = client.jobs.submit(frames(dome, sky, 2000))
    behind = client.jobs.submit(frames(dome, sky, 1, priority=10))
    assert client.jobs.prioritise(behind.id, 20).priority == 20
    assert client.jobs.cancel(behind.id).state == "cancelled"
    assert behind.id in [job.id for job in client.jobs.all(["cancelled"])]
    client.jobs.cancel(long.id)
    with pytest.raises(JobEnded, match=f"{long.id} was cancelled"):
        client.jobs.wait(long.id)
    assert client.jobs.resume(behind.id).state in ("queued", "running")
    assert client.jobs.wait(behind.id).state == "succeeded"


def test_one_token_is_one_job(client: Client, between: Between, dome: str):
    def breaks(request: httpx2.Request, send: Send) -> httpx2.Response:
        answer = send()
        if len(between.requests) == 1:
            lose(answer)
        return answer

    between.breaks = breaks
    job = client.jobs.submit(SolveJob(kind="solve", capture=dome, name="once", options=SolveOptions(method=Method.LAMBERT)))
    assert len(between.sent("POST")) == 2
    assert [one.id for one in client.jobs.all() if one.request.name == "once"] == [job.id]
    client.jobs.cancel(job.id)


@pytest.mark.long
def test_events_that_break_are_connected_again(client: Client, between: Between, dome: str, sky: str):
    known = []

    def breaks(request: httpx2.Request, send: Send) -> httpx2.Response:
        answer = send()
        if request.url.path.endswith("/events"):
            known.append(request.headers.get("last-event-id"))
            if len(known) < 4:
                answer.stream = Cut(answer.stream, 700, httpx2.ReadError)  # within the first or second event
        return answer

    between.breaks = breaks
    job = client.jobs.submit(frames(dome, sky, 120))
    seen = list(client.jobs.follow(job.id))
    assert seen[-1].state == "succeeded"
    assert [view.revision for view in seen] == sorted({view.revision for view in seen})
    assert len(known) >= 4
    assert known[0] is None
    assert known[-1] is not None


@pytest.mark.long
@pytest.mark.parametrize("answer", [
    lambda request: httpx2.Response(502, text="a proxy", request=request),
    lambda request: httpx2.Response(200, text="<html>", headers={"Content-Type": "text/html"}, request=request),
    lambda request: (_ for _ in ()).throw(httpx2.ReadTimeout("nothing comes"))])
def test_without_events_the_job_is_looked_at(client: Client, between: Between, dome: str, sky: str, answer):
    between.breaks = lambda request, send: answer(request) if request.url.path.endswith("/events") else send()
    job = client.jobs.submit(frames(dome, sky, 2))
    assert client.jobs.wait(job.id).state == "succeeded"


def test_waiting_ends_with_patience(server, key, dome: str, sky: str):
    between = Between()
    with Client(server.url, key, patience_s=0.5, transport=between) as client:
        with pytest.raises(NotFound, match="job_0123456789abcdefghjk"):
            client.jobs.wait("job_0123456789abcdefghjk")
        job = client.jobs.submit(frames(dome, sky, 1))

        def breaks(request: httpx2.Request, send: Send) -> httpx2.Response:
            raise httpx2.ConnectError("the service is gone")

        between.breaks = breaks
        with pytest.raises(Unreachable, match="does not answer: the service is gone"):
            client.jobs.wait(job.id)


def test_results_are_fetched(client: Client, results: Path, tmp_path: Path):
    told = Recording()
    found = client.jobs.download(results.name, tmp_path / "out", progress=told)
    assert [path.name for path in found] == ["asset.usdz", "frame.0001.exr", "frame.0002.exr", "report.json"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [path.name for path in found]
    for path in found:
        assert path.read_bytes() == (results / path.name).read_bytes()
    assert [stage[:2] for stage in told.stages] == [("download", -(-sum(path.stat().st_size for path in found) // 2**20))]
    assert [file.size for file in client.jobs.results(results.name)] == [path.stat().st_size for path in found]
    assert client.jobs.download(results.name, tmp_path / "one", names=["report.json"]) == [tmp_path / "one" / "report.json"]
    with pytest.raises(FileError, match=r"has no result picture\.exr"):
        client.jobs.download(results.name, tmp_path / "one", names=["picture.exr"])
    with pytest.raises(FileError, match=r"cannot make .*report\.json"):
        client.jobs.download(results.name, tmp_path / "one" / "report.json")


@pytest.mark.parametrize("runs", [1, 2])
def test_a_broken_download_is_gone_on_with(server, key, results: Path, tmp_path: Path, runs: int):
    """In the same run, or in the next one, after the first was ended with a part of the file."""
    whole = (results / "asset.usdz").read_bytes()
    asked = []

    def breaks(request: httpx2.Request, send: Send) -> httpx2.Response:
        answer = send()
        if request.method == "GET" and request.url.path.endswith(".usdz"):
            asked.append((request.headers.get("range"), answer.status_code))
            if len(asked) == 1:
                answer.stream = Cut(answer.stream, len(whole) // 2, httpx2.ReadError if runs == 1 else KeyboardInterrupt)
        return answer

    for run in range(runs):
        between = Between()
        between.breaks = breaks
        with Client(server.url, key, transport=between) as client:
            if run + 1 < runs:
                with pytest.raises(KeyboardInterrupt):
                    client.jobs.download(results.name, tmp_path, names=["asset.usdz"])
                part, = tmp_path.iterdir()
                assert part.name.startswith(".asset.usdz.")
            else:
                found, = client.jobs.download(results.name, tmp_path, names=["asset.usdz"])
    assert found.read_bytes() == whole
    assert [path.name for path in tmp_path.iterdir()] == ["asset.usdz"]
    assert asked == [(None, 200), (f"bytes={len(whole) // 2}-", 206)]


def test_a_file_that_changed_meanwhile_is_fetched_from_its_beginning(client: Client, between: Between, results: Path, tmp_path: Path):
    first, other = b"a" * 100_000, b"b" * 90_000
    etags = iter(['"1"', '"2"'])

    def breaks(request: httpx2.Request, send: Send) -> httpx2.Response:
        if not request.url.path.endswith(".usdz"):
            return send()
        etag = next(etags)
        body = first if etag == '"1"' else other
        stream = httpx2.ByteStream(body)
        return httpx2.Response(200, headers={"ETag": etag, "Content-Length": str(len(body))}, request=request,
                               stream=Cut(stream, 40_000, httpx2.ReadError) if etag == '"1"' else stream)

    between.breaks = breaks
    found, = client.jobs.download(results.name, tmp_path, names=["asset.usdz"])
    assert found.read_bytes() == other
    assert [path.name for path in tmp_path.iterdir()] == ["asset.usdz"]


@pytest.mark.parametrize("name", ["../out.exr", "/etc/out.exr", "a/../../out.exr", "a\\b.exr", "c:out.exr"])
def test_a_name_that_leads_elsewhere_is_refused(client: Client, between: Between, results: Path, tmp_path: Path, name: str):
    body = {"results": [{"name": name, "size": 1, "modified_at": "2026-01-01T00:00:00Z", "url": ""}], "next": None}
    between.breaks = lambda request, send: httpx2.Response(200, content=json.dumps(body), request=request)
    with pytest.raises(FileError, match="names a file that cannot be written here"):
        client.jobs.download(results.name, tmp_path / "in")
