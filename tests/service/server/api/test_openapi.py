"""The OpenAPI document: complete, true to what the server does, and free of paths of the server.

schemathesis runs for some seconds here. FUZZ_SECONDS=3600 in the environment lets it run for that long, with every phase on every route.
"""

import inspect
import os
import re
import types
import typing
from collections.abc import Iterator
from pathlib import Path, PurePath

import pytest
from fastapi.routing import iter_route_contexts
from pydantic import BaseModel, TypeAdapter

from service import __version__
from service.requests.answers import IntakeView, JobView, ResultView
from service.requests.base.identifiers import pattern
from service.requests.depth import DepthRequest
from service.requests.hooks import NewHook
from service.requests.jobs import UserJob
from service.server.api.intakes import NewCapture, NewEnvironment
from service.server.api.jobs import EXAMPLES, Priority
from service.server.api.operations import WORKER
from service.server.api.problems import KINDS
from service.server.base.settings import Settings
from tests.service.server.api.asgi import app_of, openapi
from tests.service.server.api.fuzz import fuzz, seed
from tests.service.server_process import serving

LONG_S = int(os.environ.get("FUZZ_SECONDS", "0"))
FREE = {"get_health", "get_readiness", "abilities"}
"""Operations that need no key."""
NO_LIMITS = {"requests_per_second": "100000", "request_burst": "100000", "max_queued": "1000000", "max_project_hooks": "1000000"}


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    with app_of(Settings(data=tmp_path_factory.mktemp("data"))) as made:
        yield made


@pytest.fixture(scope="module")
def document() -> dict:
    return openapi()


@pytest.fixture(scope="module")
def operations(document) -> dict[str, dict]:
    found = [operation for path in document["paths"].values() for operation in path.values()]
    assert len({operation["operationId"] for operation in found}) == len(found)
    return {operation["operationId"]: operation for operation in found}


@pytest.mark.long
def test_the_document_is_served_and_says_what_it_is_of(server, client, document):
    served = client.get("/v1/openapi.json").raise_for_status().json()
    assert served == document
    assert (served["info"]["title"], served["info"]["version"]) == ("Relit", __version__)
    assert [tag["name"] for tag in served["tags"]] == [
        "captures", "environments", "uploads", "jobs", "events", "results", "hooks", "operations"]
    used = [operation["tags"] for path in served["paths"].values() for operation in path.values()]
    assert {tag for tags in used for tag in tags} == {tag["name"] for tag in served["tags"]}


def test_every_operation_is_described_and_its_parameters_say_what_they_may_be(document, operations):
    assert {path for path in document["paths"] if not path.startswith("/v1/")} == {"/healthz", "/readyz", "/metrics"}  # no page
    for name, operation in operations.items():
        assert re.fullmatch(r"[a-z]+(_[a-z]+)*", name), name
        assert operation["summary"] and not operation["summary"].endswith("."), name
        assert operation["description"].endswith("."), name
        assert len(operation["tags"]) == 1, name
        assert all(response["description"] for response in operation["responses"].values()), name
        assert (operation.get("security", []) != []) == (name not in FREE), name
    patterns = {kind: pattern(prefix) for kind, prefix in
                {"capture": "cap", "environment": "env", "job": "job", "upload": "up", "hook": "hook", "annotation": "ann"}.items()}
    patterns["worker"] = WORKER
    for name, operation in operations.items():
        for parameter in operation.get("parameters", []):
            if parameter["in"] == "path" and parameter["name"] != "name":
                assert parameter["schema"]["pattern"] == patterns[parameter["name"]], name
            assert parameter["schema"].get("type") not in (None, "null"), (name, parameter)  # one type, and never null


def test_every_refusal_is_a_problem_with_an_example(document, operations):
    titles = {str(kind.status): kind.title for kind in KINDS.values()}
    for name, operation in operations.items():
        for status, response in operation["responses"].items():
            assert "X-Request-Id" in response["headers"], (name, status)
            if int(status) < 400:
                continue
            assert list(response["content"]) == ["application/problem+json"], (name, status)
            content = response["content"]["application/problem+json"]
            assert content["schema"] == {"$ref": "#/components/schemas/Problem"}
            assert (content["example"]["status"], content["example"]["title"]) == (int(status), titles[status])
        if operation.get("security"):
            assert {"401", "403", "429"} <= operation["responses"].keys(), name
            assert "Retry-After" in operation["responses"]["429"]["headers"]
            assert "WWW-Authenticate" in operation["responses"]["401"]["headers"]
        if "application/json" in operation.get("requestBody", {}).get("content", {}):
            assert {"400", "413", "415", "422"} <= operation["responses"].keys(), name
            assert operation["requestBody"]["content"]["application/json"]["examples"], name
        if any(parameter["in"] == "path" for parameter in operation.get("parameters", [])):
            assert {"404", "422"} <= operation["responses"].keys(), name


def test_schemas_name_their_fields_and_take_no_others_and_the_examples_of_jobs_are_jobs(document):
    schemas = document["components"]["schemas"]
    assert "HTTPValidationError" not in schemas
    for name, schema in schemas.items():
        if name.endswith(("Job", "Options", "Choices", "Light", "Key", "Keys", "Track", "Capture", "Environment", "Priority", "NewHook")):
            assert schema.get("additionalProperties") is False or "enum" in schema, name
    assert schemas["RelightOptions"]["properties"]["frames"]["description"].startswith("A number, or first-last; null:")
    adapter = TypeAdapter(UserJob)
    kinds = {adapter.validate_python(example["value"]).kind for example in EXAMPLES.values()}
    assert kinds == {"solve", "depth", "relight", "shade", "export", "view", "pipeline"}


@pytest.mark.parametrize("model", [JobView, IntakeView, ResultView])
def test_the_examples_of_answers_are_answers(document, model):
    example, = document["components"]["schemas"][model.__name__]["examples"]
    assert model.model_validate(example, strict=False).model_dump(mode="json", exclude_unset=True) == example


def models_in(kind: object) -> Iterator[type[BaseModel]]:
    """Every model that a type is made of."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        yield kind
        for field in kind.model_fields.values():
            yield from models_in(field.annotation)
    for part in typing.get_args(kind):
        yield from models_in(part)


def holds_path(kind: object) -> bool:
    if isinstance(kind, type) and not isinstance(kind, types.GenericAlias):
        return issubclass(kind, PurePath)
    return any(holds_path(part) for part in typing.get_args(kind))


def paths_in(kind: object) -> set[str]:
    return {f"{model.__name__}.{name}" for model in models_in(kind) for name, field in model.model_fields.items()
            if holds_path(field.annotation)}


def test_no_request_or_parameter_of_the_api_has_a_path_of_the_server(app):
    assert paths_in(DepthRequest) == {
        "DepthRequest.beside", "DepthRequest.cache", "DepthRequest.capture", "DepthRequest.out", "TofOptions.calibration"}
    for body in (UserJob, NewCapture, NewEnvironment, Priority, NewHook):
        assert len(list(models_in(body))) >= 1 and paths_in(body) == set()
    routes = [route for route in iter_route_contexts(app.routes) if route.path.startswith("/v1/")]
    assert len(routes) > 20
    for route in routes:
        for parameter in inspect.signature(route.endpoint).parameters.values():
            assert not holds_path(parameter.annotation), (route.path, parameter)


def test_methods_that_are_not_there_are_refused_with_those_that_are(client, document):
    for path, methods in document["paths"].items():
        asked = re.sub(r"\{(\w+)\}", "x", path)
        response = client.request("PUT", asked)
        assert response.status_code == 405 and response.headers["Content-Type"] == "application/problem+json", path
        assert {method.upper() for method in methods} <= set(response.headers["Allow"].split(", ")), path


def run(folder: Path, *asked: tuple[str, int, str | None], **settings: str) -> None:
    """Run schemathesis, with phases, examples and operations that are left out, against one server."""
    with serving(folder, "--device", "none", **NO_LIMITS, **settings) as server:
        key, known = seed(Settings(data=server.data, **settings))
        for phases, examples, exclude in asked:
            done = fuzz(server, key, known, folder, examples=examples, phases=phases, max_time_s=LONG_S or None, exclude=exclude)
            assert done.returncode == 0 and "No issues found" in done.stdout, done.stdout[-20000:] + done.stderr[-4000:]
        log = server.log.read_text()
    assert '"request failed"' not in log and "Traceback" not in log


@pytest.mark.long
@pytest.mark.skipif(LONG_S > 0, reason="FUZZ_SECONDS asks for the long run")
def test_schemathesis_finds_nothing(tmp_path):
    # of these there are thousands at the edges of values: the others are random
    run(tmp_path, ("examples,coverage", 1, "^(create_job|list_.*)$"), ("fuzzing,stateful", 3, None))


@pytest.mark.long
@pytest.mark.skipif(LONG_S == 0, reason="set FUZZ_SECONDS to run schemathesis for that long")
def test_schemathesis_finds_nothing_for_long(tmp_path, database_url):
    url = {} if database_url is None else {"database_url": database_url}
    run(tmp_path, ("examples,coverage,fuzzing,stateful", 1000, None), **url)
