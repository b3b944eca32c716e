"""Following a job by server-sent events, reconnected when they break, and by plain requests while they bring nothing."""

import time
from collections.abc import Iterator

import httpx2

from service.client.connection import Connection
from service.views.jobs import JobView
from service.views.states import ENDED

EVENT = "job"
SILENCE_S = 45.0
"""A stream without a byte for this long is given up: the service sends at least a comment every 15 s."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 2.0
"""Between two plain requests, while events bring nothing."""


def follow(connection: Connection, job: str) -> Iterator[JobView]:
    """Yield a job as it is now, and again after every change, until it has ended.

    Args:
        connection: to the service.
        job: path of the job in the API.

    Raises:
        Refused: there is no such job, or the key does not allow to read it.
        Unreachable: the service does not answer.
    """
    last: JobView | None = None
    pause = FIRST_PAUSE_S
    while True:
        before = last
        try:
            for view in _stream(connection, job, last):
                if last is None or view.revision > last.revision:
                    last = view
                    yield view
                    if view.state in ENDED:
                        return
        except httpx2.TransportError:
            pass
        if last is not before:
            pause = FIRST_PAUSE_S
            continue
        view = JobView.model_validate_json(connection.send("GET", job).content)  # its error also says why there are no events
        if last is None or view.revision > last.revision:
            last = view
            yield view
        if view.state in ENDED:
            return
        time.sleep(pause)
        pause = min(2 * pause, LONGEST_PAUSE_S)


def _stream(connection: Connection, job: str, last: JobView | None) -> Iterator[JobView]:
    """Yield the views of one stream of events after `last`; nothing if the service refuses the stream."""
    headers = {} if last is None else {"Last-Event-ID": str(last.revision)}
    with connection.http.sse(f"{job}/events", headers=headers, timeout=SILENCE_S) as events:
        if events.response.is_success:
            for event in events:
                if event.event == EVENT:
                    yield JobView.model_validate_json(event.data)
