"""A job as it changes: server-sent events, connected again when they break, with a plain look whenever they bring nothing."""

import time
from collections.abc import Iterator

import httpx2

from service.client.link import Link
from service.server.api.views import JobView

ENDED = ("succeeded", "failed", "cancelled")
EVENT = "job"
SILENCE_S = 45.0
"""After which a stream is given up: the service says at least every 15 s that it is there."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 2.0
"""Between two looks, while events bring nothing."""


def follow(link: Link, job: str) -> Iterator[JobView]:
    """A job as it is, then as it becomes with every change, until it has ended.

    Args:
        link: to the service.
        job: its path.

    Raises:
        Refused: there is no such job, or the key does not allow to see it.
        Unreachable: the service does not answer.
    """
    last: JobView | None = None
    pause = FIRST_PAUSE_S
    while True:
        before = last
        try:
            for view in _stream(link, job, last):
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
        view = JobView.model_validate_json(link.send("GET", job).content)  # says, too, why there are no events
        if last is None or view.revision > last.revision:
            last = view
            yield view
        if view.state in ENDED:
            return
        time.sleep(pause)
        pause = min(2 * pause, LONGEST_PAUSE_S)


def _stream(link: Link, job: str, last: JobView | None) -> Iterator[JobView]:
    """What one connection brings; nothing where it is refused."""
    headers = {} if last is None else {"Last-Event-ID": str(last.revision)}
    with link.http.sse(f"{job}/events", headers=headers, timeout=SILENCE_S) as events:
        if events.response.is_success:
            for event in events:
                if event.event == EVENT:
                    yield JobView.model_validate_json(event.data)
