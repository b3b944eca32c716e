"""The client against the OpenAPI document: what it sends is documented, and what it reads is what the document promises; and the examples
of its page."""

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import httpx2
import jsonschema_rs
import pytest
from pydantic import TypeAdapter

from service.client import Client
from service.client.errors import Fault
from service.requests import answers as shared_answers
from service.requests.answers import View
from service.requests.hooks import NewHook
from service.requests.jobs import ExportJob, RelightJob, SolveJob, UserJob
from service.requests.relight import RelightOptions
from service.requests.solve import Method, SolveOptions
from tests.scenes.captures import write_capture
from tests.service.client.conftest import HOME, OWL, SKY, Between, lose
from tests.service.server.api.asgi import openapi

OF_HTTP = {"host", "accept", "accept-encoding", "connection", "user-agent", "authorization", "content-length", "content-type",
           "transfer-encoding", "cache-control"}
"""Headers that HTTP itself knows, and the key, which is a security scheme of the document."""
USED = {
    "POST /v1/captures", "GET /v1/captures", "GET /v1/captures/{capture}", "DELETE /v1/captures/{capture}",
    "POST /v1/captures/{capture}/validate", "POST /v1/captures/{capture}/files", "HEAD /v1/uploads/{upload}", "PATCH /v1/uploads/{upload}",
    "POST /v1/environments", "GET /v1/environments/{environment}",
    "POST /v1/jobs", "GET /v1/jobs", "GET /v1/jobs/{job}", "PATCH /v1/jobs/{job}", "DELETE /v1/jobs/{job}", "POST /v1/jobs/{job}/cancel",
    "POST /v1/jobs/{job}/retry", "POST /v1/jobs/{job}/resume", "GET /v1/jobs/{job}/events",
    "GET /v1/jobs/{job}/results", "GET /v1/jobs/{job}/results/{name}", "HEAD /v1/jobs/{job}/results/{name}",
    "POST /v1/hooks", "GET /v1/hooks", "GET /v1/hooks/{hook}", "POST /v1/hooks/{hook}/test", "DELETE /v1/hooks/{hook}"}


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    return openapi()


def resolved(document: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in schema:
        found: Any = document
        for part in schema["$ref"].removeprefix("#/").split("/"):
            found = found[part]
        schema = found
    return schema


class Recorded(Between):
    """Every request with the status and the body of its answer."""

    def __init__(self) -> None:
        super().__init__()
        self.answers: list[tuple[httpx2.Request, int, str, bytes]] = []

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        answer = super().handle_request(request)
        media_type = answer.headers.get("content-type", "").partition(";")[0]
        body = b""
        if media_type == "application/json":
            body = answer.read()
        self.answers.append((request, answer.status_code, media_type, body))
        return answer


def operation_of(document: dict[str, Any], request: httpx2.Request) -> tuple[str, dict[str, Any]]:
    """Its name, and what is said of it; of the paths that fit the most literal."""
    parts = request.url.path.strip("/").split("/")
    fitting = []
    for path in document["paths"]:
        pattern = path.strip("/").split("/")
        if len(pattern) == len(parts) and all(one == other or one.startswith("{") for one, other in zip(pattern, parts, strict=True)):
            fitting.append(path)
    assert fitting, f"{request.url.path} is no path of the document"
    path = min(fitting, key=lambda one: one.count("{"))
    assert request.method.lower() in document["paths"][path], f"{request.method} {path} is not in the document"
    return f"{request.method} {path}", document["paths"][path][request.method.lower()]


def everything(client: Client, between: Between, folder: Path, dome: str, sky: str) -> None:
    """Call all that the client can."""
    def lose_one_answer(request: httpx2.Request, send: Any) -> httpx2.Response:
        answer = send()
        if request.method == "PATCH":
            between.breaks = lambda request, send: send()
            lose(answer)
        return answer

    between.breaks = lose_one_answer
    capture = client.captures.upload(write_capture(folder / "contract"))
    list(client.captures.all())
    client.environments.register(str(SKY))
    blocker = client.jobs.submit(RelightJob(kind="relight", capture=dome, environment=sky, options=RelightOptions(frames="1-300")))
    solve = client.jobs.submit(SolveJob(kind="solve", capture=capture.id, options=SolveOptions(method=Method.LAMBERT), priority=10))
    client.jobs.cancel(solve.id)
    client.jobs.prioritise(client.jobs.resume(solve.id).id, 5)
    client.jobs.cancel(client.jobs.get(blocker.id).id)
    client.jobs.wait(solve.id)
    failed = client.jobs.submit(SolveJob(kind="solve", capture=capture.id, options=SolveOptions(method=Method.GRADIENT)))
    *_, last = client.jobs.follow(failed.id)
    assert last.state == "failed"
    client.jobs.retry(failed.id)
    *_, _ = client.jobs.follow(failed.id)
    export = client.jobs.submit(ExportJob(kind="export", maps=solve.id))
    client.jobs.wait(export.id)
    list(client.jobs.all(["succeeded"]))

    def break_download(request: httpx2.Request, send: Any) -> httpx2.Response:
        answer = send()
        if request.url.path.endswith(".usdz"):
            between.breaks = lambda request, send: send()
            answer.close()
            raise httpx2.ReadError("lost")
        return answer

    between.breaks = break_download
    (folder / "out").mkdir()
    (folder / "out" / f".asset.usdz.{'0' * 16}.part").write_bytes(b"of another version")  # so that HEAD is asked
    client.jobs.download(export.id, folder / "out")
    client.jobs.delete(export.id)
    hook = client.hooks.create(NewHook(url="https://tracker.example/relit"))
    client.hooks.test(hook.id)
    assert [each.id for each in client.hooks.all()] == [client.hooks.get(hook.id).id] == [hook.id]
    client.hooks.delete(hook.id)
    client.captures.delete(capture.id)


@pytest.mark.long
def test_what_the_client_sends_is_documented_and_what_it_reads_is_promised(server, key, document, dome, sky, tmp_path: Path):
    recorded = Recorded()
    with Client(server.url, key, transport=recorded) as client:
        everything(client, recorded, tmp_path, dome, sky)
    used = set()
    for request, status, media_type, body in recorded.answers:
        name, operation = operation_of(document, request)
        used.add(name)
        parameters = [resolved(document, one) for one in operation.get("parameters", [])]
        where = {(one["in"], one["name"].lower()) for one in parameters}
        for given, _ in parse_qsl(request.url.query.decode()):
            assert ("query", given.lower()) in where, f"{name}: query {given}"
        for given in request.headers:
            assert given in OF_HTTP or ("header", given) in where, f"{name}: header {given}"
        for one in parameters:
            if one.get("required") and one["in"] != "path":
                sent = request.headers if one["in"] == "header" else dict(parse_qsl(request.url.query.decode()))
                assert one["name"] in sent, f"{name}: {one['name']} is missing"
        if request.headers.get("content-type") == "application/json":
            schema = operation["requestBody"]["content"]["application/json"]["schema"]
            jsonschema_rs.validator_for({**schema, "components": document["components"]}).validate(json.loads(request.read()))
        assert str(status) in operation["responses"], f"{name}: {status}"
        if media_type == "application/json" and body:
            schema = operation["responses"][str(status)]["content"]["application/json"]["schema"]
            jsonschema_rs.validator_for({**schema, "components": document["components"]}).validate(json.loads(body))
    assert used == USED


def test_the_shared_views_are_the_answers_of_the_document(document):
    """Every answer in JSON is a model of service.requests.answers, with the same fields, or a problem; so the client can read all."""
    answers = {content["schema"]["$ref"].rpartition("/")[2] for path in document["paths"].values() for operation in path.values()
               for status, response in operation["responses"].items() if status.startswith("2")
               for kind, content in response.get("content", {}).items() if kind == "application/json" and "$ref" in content["schema"]}
    shared = {model.__name__: model for model in vars(shared_answers).values()
              if isinstance(model, type) and issubclass(model, View) and model is not View}
    assert answers - shared.keys() == {"Health", "AnnotationPage", "AnnotationView"}  # annotations are models of their own, in W3C's form
    assert answers >= {"JobView", "JobPage", "IntakeView", "IntakePage", "ResultPage", "FileView", "FilePage"}
    for name, model in shared.items():
        promised = document["components"]["schemas"][name]
        assert set(promised["properties"]) == set(model.model_fields), name
        assert set(promised["required"]) == {field for field, one in model.model_fields.items() if one.is_required()}, name
    assert set(document["components"]["schemas"]["Fault"]["properties"]) == set(Fault._fields)


def test_the_jobs_that_can_be_handed_in_are_those_of_the_document(document):
    body = document["paths"]["/v1/jobs"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    promised, ours = resolved(document, body)["discriminator"]["mapping"], TypeAdapter(UserJob).json_schema()
    assert set(promised) == set(ours["discriminator"]["mapping"])
    for kind, reference in promised.items():
        name = ours["discriminator"]["mapping"][kind].rpartition("/")[2]
        assert set(resolved(document, {"$ref": reference})["properties"]) == set(ours["$defs"][name]["properties"])


TEXT = (HOME / "docs" / "python_client.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.long
def test_the_program_runs(server, key, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    program, = blocks("python")
    monkeypatch.chdir(tmp_path)
    for said, meant in (("http://127.0.0.1:8470", server.url), ("key_…", key), ("samples/owl", str(OWL))):
        assert said in program
        program = program.replace(said, meant)
    names: dict[str, object] = {}
    exec(compile(program, "python_client.md", "exec"), names)
    assert names["frames"] == [Path("result") / f"frame.{number:04d}.exr" for number in (1, 2, 3)]
    assert sorted(path.name for path in (tmp_path / "result").iterdir()) == [path.name for path in names["frames"]]


@pytest.mark.long
def test_the_first_command_runs(relit, server, key, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    line = next(line for line in blocks("sh")[1].splitlines() if "submit pipeline" in line)
    small = write_capture(tmp_path / "ball")
    shutil.copy(SKY, small)
    words = shlex.split(line.replace("samples/owl", str(small)).replace("1-24", "1-2"))
    monkeypatch.setenv("RELIT_SERVER", server.url)
    monkeypatch.setenv("RELIT_KEY", key)
    monkeypatch.chdir(tmp_path)
    assert relit(*words[1:]).code == 0
    assert {"asset.usdz", "frame.0001.exr", "maps.exr"} <= {path.name for path in (tmp_path / "result").iterdir()}


def test_every_command_and_option_that_is_named_exists_and_every_method_is_named(relit):
    lines = [shlex.split(line, comments=True) for block in blocks("sh")[1:] for line in block.splitlines() if line.startswith("relit")]
    assert len(lines) > 6
    for _, group, command, *words in lines:
        out = relit(group, command, "--help").well()
        for word in words:
            assert not word.startswith("--") or word in out, (group, command, word)
    with Client() as client:
        for part in (client.captures, client.annotations, client.jobs):
            for name in dir(part):
                assert name.startswith("_") or f"`{name}`" in TEXT, name
