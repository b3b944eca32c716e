"""Leases of event streams: who may open one, whichever API process is asked.

A stream costs the database one transaction when it is opened, which it shares with all that are opened at the same time, and none for its
events. While streams are open, their number is written again every RENEW_S; when some have ended, once within SETTLE_S.
"""

import asyncio
import secrets
import time
from collections import Counter
from contextlib import suppress

from service.server.api.problems import RETRY_S, ApiError
from service.server.database import streams
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.keys import Caller
from service.server.database.streams import Holder, Limits
from service.server.log import logger

RENEW_S = 5.0
"""Seconds between two writes of what is open: a lease outlives three that fail."""
SETTLE_S = 0.5
"""Seconds after which streams that have ended are no longer counted by other processes."""
REFUSED_S = 1.0
"""Seconds for which a refusal counts without asking the database again."""


class StreamLeases:
    """The leases of this process. Everything but the transactions runs in the event loop."""

    def __init__(self, database: Database, limits: Limits) -> None:
        """Args: database: of the service. limits: of streams over all processes."""
        self._database, self._limits = database, limits
        self._process = secrets.token_hex(16)
        self._held: Counter[Holder] = Counter()
        self._asked: list[tuple[Holder, asyncio.Future[str | None]]] = []
        self._refused: dict[Holder, tuple[float, str]] = {}
        self._news = asyncio.Event()
        self._released = False
        self._task: asyncio.Task[None] | None = None

    async def take(self, caller: Caller) -> Holder:
        """Let a caller open a stream, until `release`.

        Raises:
            ApiError: its key or its project has as many as it may.
            DBAPIError: the database does not answer.
        """
        holder = Holder(caller.project, caller.key or "")
        refusal = self._limits.refusal(holder, self._held)
        until, before = self._refused.get(holder, (0.0, None))
        if refusal is None and time.monotonic() < until:
            refusal = before
        if refusal is None:
            answer: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()
            self._asked.append((holder, answer))
            self._news.set()
            if self._task is None or self._task.done():
                self._task = asyncio.get_running_loop().create_task(self._run())
            refusal = await answer
        if refusal is not None:
            raise ApiError("too-many", refusal, headers={"Retry-After": str(RETRY_S)})
        return holder

    def release(self, holder: Holder) -> None:
        """Record that a stream has ended."""
        self._held[holder] -= 1
        if not self._held[holder]:
            del self._held[holder]
        self._refused = {}
        self._released = True
        self._news.set()

    def close(self) -> None:
        """Count no stream of this process any more; for its end, when the event loop has ended."""
        if self._task is not None:
            with suppress(*UNANSWERED):  # then they expire
                streams.record(self._database, self._process, {}, [], self._limits)

    async def _run(self) -> None:
        """Write what is open and asked for, until nothing is."""
        silent = False
        while True:
            asked, self._asked = self._asked, []
            held = dict(self._held)
            try:
                answers = await asyncio.to_thread(
                    streams.record, self._database, self._process, held, [holder for holder, _ in asked], self._limits)
                silent = False
            except Exception as error:
                for _, answer in asked:
                    if not answer.done():
                        answer.set_exception(error)
                if not isinstance(error, UNANSWERED):
                    logger.error("counting streams of events failed", exc_info=error)
                elif not silent:
                    logger.warning("database does not answer: open streams are not counted elsewhere", error=message_of(error))
                silent = True
                if not self._held and not self._asked:
                    return  # what it has of this process expires
            else:
                self._tell(asked, answers)
                if not self._held and not held and not self._asked:
                    return  # the database has nothing of this process
            await self._pause()

    def _tell(self, asked: list[tuple[Holder, "asyncio.Future[str | None]"]], answers: list[str | None]) -> None:
        now = time.monotonic()
        self._refused = {holder: found for holder, found in self._refused.items() if found[0] > now}
        for (holder, answer), refusal in zip(asked, answers, strict=True):
            if answer.done():  # who asked has gone
                self._released = self._released or refusal is None
                continue
            if refusal is None:
                self._held[holder] += 1
            else:
                self._refused[holder] = now + REFUSED_S, refusal
            answer.set_result(refusal)

    async def _pause(self) -> None:
        """Wait until a stream is asked for, some have ended SETTLE_S ago, or it is time to write again."""
        until = time.monotonic() + RENEW_S
        while not self._asked and (left := until - time.monotonic()) > 0:
            if self._released:
                self._released, until = False, min(until, time.monotonic() + SETTLE_S)
                continue
            self._news.clear()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._news.wait(), left)
