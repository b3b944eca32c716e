"""The OpenAPI document: what FastAPI makes of the routes, said as it is."""

from collections.abc import Iterator
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.server.api.problems import KINDS, MEDIA_TYPE, OF_STATUS

TAGS = {
    "captures": "What was photographed: uploaded file by file, or registered where it lies on the server.",
    "environments": "Lat-long maps that jobs light a capture with; they come as captures do.",
    "uploads": "Files on their way in, by the tus 1.0 protocol: gone on with after a break, checked by checksum.",
    "jobs": "Work that is queued, done by workers, and outlives any of them.",
    "events": "Jobs as they change, without asking again and again.",
    "results": "What jobs have made.",
    "operations": "For those who keep the service running.",
}
REQUEST_ID = {"description": "Name of the request in the log.", "schema": {"type": "string"}}
RETRY_AFTER = {"description": "Seconds until it is worth trying again.", "schema": {"type": "integer", "minimum": 0}}
HEADERS: dict[int, dict[str, Any]] = {
    401: {"WWW-Authenticate": {"description": "Bearer.", "schema": {"type": "string"}}},
    416: {"Content-Range": {"description": "bytes */ and the size of the file.", "schema": {"type": "string"}}},
    **{status: {"Retry-After": RETRY_AFTER} for status in (429, 503, 507)},
}
LOCATION = {"description": "Path of what was created.", "schema": {"type": "string"}}
EXAMPLES: dict[str, dict[str, Any]] = {
    "JobView": {
        "id": "job_0123456789abcdefghjk", "state": "running", "attempt": 1, "revision": 7, "priority": 50,
        "request": {"kind": "relight", "capture": "cap_0123456789abcdefghjk", "environment": "env_0123456789abcdefghjk",
                    "options": {"frames": "1-240", "spin_degrees": 360.0}},
        "created_at": "2026-11-20T09:00:00Z", "started_at": "2026-11-20T09:00:01Z", "finished_at": None,
        "progress": {"stage": "frames", "done": 60, "total": 240, "rate": 20.0, "remaining_s": 9.0}, "error": None},
    "IntakeView": {
        "id": "cap_0123456789abcdefghjk", "name": "owl", "state": "ready", "registered": False, "problem": None,
        "facts": {"captures": 1, "frames": 96, "resolution": [320, 320], "color_space": "lin_rec709_scene", "name": "owl"},
        "created_at": "2026-11-20T08:59:00Z"},
    "ResultView": {
        "name": "frame.0001.exr", "size": 177062, "modified_at": "2026-11-20T09:00:02Z",
        "url": "/v1/jobs/job_0123456789abcdefghjk/results/frame.0001.exr"},
}
"""Of answers. FastAPI would leave out what is null, and a null is said here."""
METHODS = ("options", "get", "head", "post", "put", "patch", "delete")
WITH_BODY = (400, 413, 415)
"""How every body can be refused, beside by what it says."""


def install(app: FastAPI) -> None:
    """Serve the document of the app's routes."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = _document(app)
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]


def _document(app: FastAPI) -> dict[str, Any]:
    made = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes,
                       tags=[{"name": name, "description": text} for name, text in TAGS.items()],
                       license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"})
    for operation in _operations(made):
        _describe(operation)
    for name, example in EXAMPLES.items():
        made["components"]["schemas"][name]["examples"] = [example]
    for schema in made["components"]["schemas"].values():
        for field in schema.get("properties", {}).values():
            if "description" in field:
                field["description"] = field["description"].replace("None:", "null:")  # written beside Python, read beside JSON
    return made


def _operations(document: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for path in document["paths"].values():
        yield from (path[method] for method in METHODS if method in path)


def _describe(operation: dict[str, Any]) -> None:
    for parameter in operation.get("parameters", []):
        parameter["schema"] = _without_null(parameter["schema"])  # a parameter is there or not
    body = operation.get("requestBody", {}).get("content", {})
    for status in WITH_BODY if "application/json" in body else ():
        operation["responses"].setdefault(str(status), {"description": KINDS[OF_STATUS[status]].title})
    for text, response in operation["responses"].items():
        status = int(text)
        headers = {"X-Request-Id": REQUEST_ID, **HEADERS.get(status, {})}
        if status in (201, 202) and operation["operationId"].startswith("create_"):
            headers["Location"] = LOCATION
        response["headers"] = headers | response.get("headers", {})
        if status >= 400:
            response["content"] = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}, "example": _example(status)}}
    operation["responses"] = dict(sorted(operation["responses"].items()))


def _without_null(schema: dict[str, Any]) -> dict[str, Any]:
    options = [option for option in schema.get("anyOf", []) if option.get("type") != "null"]
    if len(options) != 1:
        return schema
    return {key: value for key, value in schema.items() if key != "anyOf"} | options[0]


def _example(status: int) -> dict[str, Any]:
    kind = OF_STATUS[status]
    return {"type": f"urn:relit:problem:{kind}", "title": KINDS[kind].title, "status": status, "detail": "One sentence for a person.",
            "request_id": "0123456789abcdef", "errors": []}
