"""The OpenAPI document: that of FastAPI, with the headers, examples and problems that it leaves out."""

from functools import cache
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.server.api.problems import KINDS, MEDIA_TYPE, OF_STATUS

TAGS = {
    "captures": "Photographs with their manifest: uploaded file by file, or registered where they lie on the server.",
    "environments": "Lat-long maps by which jobs light a capture; created as captures are.",
    "uploads": "Files of captures and environments, by the tus 1.0 protocol: resumed after an interruption, verified by checksums.",
    "jobs": "Requests for work, which are queued, and survive the workers that do them.",
    "events": "Changes of jobs, as server-sent events.",
    "results": "Files that jobs have made.",
    "hooks": "URLs that are told by a signed request how jobs have ended.",
    "operations": "Health, readiness and metrics, for operators.",
}
REQUEST_ID = {"description": "Identifier of the request in the log.", "schema": {"type": "string"}}
RETRY_AFTER = {"description": "Seconds until the request may succeed.", "schema": {"type": "integer", "minimum": 0}}
HEADERS: dict[int, dict[str, Any]] = {
    401: {"WWW-Authenticate": {"description": "Bearer.", "schema": {"type": "string"}}},
    416: {"Content-Range": {"description": "bytes */ and the size of the file.", "schema": {"type": "string"}}},
    **{status: {"Retry-After": RETRY_AFTER} for status in (429, 503, 507)},
}
LOCATION = {"description": "Path of the new resource.", "schema": {"type": "string"}}
EXAMPLES: dict[str, dict[str, Any]] = {
    "JobView": {
        "id": "job_0123456789abcdefghjk", "state": "running", "attempt": 1, "revision": 7, "priority": 50,
        "request": {"kind": "relight", "capture": "cap_0123456789abcdefghjk", "environment": "env_0123456789abcdefghjk",
                    "options": {"frames": "1-240", "spin_degrees": 360.0}},
        "created_at": "2026-11-20T09:00:00Z", "started_at": "2026-11-20T09:00:01Z", "finished_at": None,
        "progress": {"stage": "frames", "done": 60, "total": 240, "rate": 20.0, "remaining_s": 9.0}, "error": None},
    "IntakeView": {
        "id": "cap_0123456789abcdefghjk", "name": "owl", "state": "ready", "registered": False, "problem": None,
        "facts": {"captures": 1, "frames": 96, "resolution": [320, 320], "color_space": "lin_rec709_scene", "name": "owl",
                  "lit_by": ["light"], "calibrated": ["lights"]},
        "view": "job_0123456789abcdefghjm", "created_at": "2026-11-20T08:59:00Z"},
    "ResultView": {
        "name": "frame.0001.exr", "size": 177062, "modified_at": "2026-11-20T09:00:02Z",
        "url": "/v1/jobs/job_0123456789abcdefghjk/results/frame.0001.exr"},
}
"""Examples of answers. FastAPI would leave out fields that are null."""
METHODS = ("options", "get", "head", "post", "put", "patch", "delete")
WITH_BODY = (400, 413, 415)
"""Statuses with which any body can be refused, whatever its content."""


def install(app: FastAPI) -> None:
    """Make the app serve the document of its routes."""
    app.openapi = cache(lambda: _document(app))  # type: ignore[method-assign]


def _document(app: FastAPI) -> dict[str, Any]:
    made = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes,
                       tags=[{"name": name, "description": text} for name, text in TAGS.items()],
                       license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"})
    for operation in (path[method] for path in made["paths"].values() for method in METHODS if method in path):
        _describe(operation)
    for name, example in EXAMPLES.items():
        made["components"]["schemas"][name]["examples"] = [example]
    for schema in made["components"]["schemas"].values():
        for field in schema.get("properties", {}).values():
            if "description" in field:
                field["description"] = field["description"].replace("None:", "null:")  # docstrings are about Python
    return made


def _describe(operation: dict[str, Any]) -> None:
    for parameter in operation.get("parameters", []):
        parameter["schema"] = _without_null(parameter["schema"])  # a parameter is given or not, and never null
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
            kind = OF_STATUS[status]
            example = {"type": f"urn:relit:problem:{kind}", "title": KINDS[kind].title, "status": status,
                       "detail": "One sentence for a person.", "request_id": "0123456789abcdef", "errors": []}
            response["content"] = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}, "example": example}}
    operation["responses"] = dict(sorted(operation["responses"].items()))


def _without_null(schema: dict[str, Any]) -> dict[str, Any]:
    options = [option for option in schema.get("anyOf", []) if option.get("type") != "null"]
    if len(options) != 1:
        return schema
    return {key: value for key, value in schema.items() if key != "anyOf"} | options[0]
