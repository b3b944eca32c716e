"""Routes that stream the changes of jobs as server-sent events (https://html.spec.whatwg.org/multipage/server-sent-events.html)."""

import json
from collections.abc import AsyncIterator
from contextlib import ExitStack
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Response
from fastapi.sse import KEEPALIVE_COMMENT, EventSourceResponse, format_sse_event
from starlette.types import Receive, Scope, Send

from service.requests.answers import JobView
from service.requests.states import ENDED
from service.server.api.context import Reader, Service, ServiceDep
from service.server.api.jobs import get_job
from service.server.api.problems import responses
from service.server.api.watch import Listener
from service.server.database.keys import Caller

router = APIRouter(tags=["events"], responses=responses(401, 403, 429, 503))

SILENCE_S = 15.0
"""Seconds without an event after which a comment is sent, so that no proxy closes the connection."""
HEADERS = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}  # the second header is for nginx, which would delay events
EXAMPLE = 'event: job\ndata: {"id": "job_0123456789abcdefghjk", "state": "running", …}\nid: 7\n\n'
STREAM: dict[str, Any] = {
    "description": "Events `job`, each with a JobView as data and its revision as id, and `gone` with the id of a job that was deleted.",
    "content": {"text/event-stream": {"example": EXAMPLE}}}
NOTHING_MORE: dict[str, Any] = {"description": "The job has ended, and Last-Event-ID is its last event: a browser connects no more."}
LastEvent = Annotated[str | None, Header(
    alias="Last-Event-ID", pattern=r"^[0-9]{1,18}$", description="Id of the last event that came: only later ones are sent.")]


@router.get("/v1/jobs/{job}/events", responses={**responses(404, 422), 200: STREAM, 204: NOTHING_MORE}, response_class=Response,
            summary="Watch a job")
async def stream_job(service: ServiceDep, caller: Reader, found: Annotated[JobView, Depends(get_job)], last: LastEvent = None) -> Response:
    """Send the job as it is, and then with every change; the stream ends when the job has ended."""
    known = int(last) if last is not None and int(last) <= found.revision else 0
    if found.state in ENDED and known == found.revision:
        return Response(status_code=204)
    return await _stream(service, caller, found.id, after=known, to_its_end=True)


@router.get("/v1/events", responses={200: STREAM}, response_class=Response, summary="Watch all jobs of the project")
async def stream_jobs(service: ServiceDep, caller: Reader) -> Response:
    """Send the jobs that have not ended or ended lately, then every job of the project as it changes; the stream does not end."""
    return await _stream(service, caller, caller.project, after=0, to_its_end=False)


async def _stream(service: Service, caller: Caller, topic: str, *, after: int, to_its_end: bool) -> "_Stream":
    with ExitStack() as held:
        for streams, holder in ((service.key_streams, caller.key), (service.project_streams, caller.project)):
            streams.enter(holder)
            held.callback(streams.leave, holder)
        listener = service.watcher.listen(topic, after=after, caller=caller)
        held.callback(service.watcher.remove, listener)
        return _Stream(listener, held.pop_all(), to_its_end=to_its_end)


class _Stream(EventSourceResponse):
    """The events of a listener, which is removed when the answer ends, also if it never began."""

    def __init__(self, listener: Listener, held: ExitStack, *, to_its_end: bool) -> None:
        self._held = held
        super().__init__(_events(listener, to_its_end=to_its_end), headers=HEADERS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._held.close()


async def _events(listener: Listener, *, to_its_end: bool) -> AsyncIterator[bytes]:
    while (news := await listener.take(SILENCE_S)) is not None:
        if not news:
            yield KEEPALIVE_COMMENT
        for change in news:
            if change.data is None:
                yield format_sse_event(event="gone", data_str=json.dumps({"id": change.job}))
            else:
                yield format_sse_event(event="job", data_str=change.data, id=str(change.revision) if to_its_end else None)
        if to_its_end and any(change.ended for change in news):
            return
