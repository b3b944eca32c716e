"""Leases of requests: how often a key may ask, whichever API process it asks.

Of a lease a process counts the requests by itself. The next one costs a transaction, which all keys share whose requests wait for one: some
of them a second of a key that asks as often as it may, and one in LEASE_S of a key that asks seldom.
"""

import asyncio
import math
import secrets
import time
from typing import NoReturn

from service.server.api.problems import ApiError
from service.server.database import rates
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.rates import LEASE_S, Leased, Rate, Wanted
from service.server.log import logger

PATIENCE_S = 2.0
"""Seconds that a request waits for the database, which another program may have locked; then it goes on, counted by its process alone."""
AWAY_S = 1.0
"""Seconds for which a database that did not answer is not asked again; every process counts by itself meanwhile."""
FORGET_ABOVE = 10_000
"""Number of keys above which those are forgotten whose lease has expired: what they did not use comes back to the bucket with time."""


class RequestLeases:
    """The leases of this process. Everything but the transactions runs in the event loop."""

    def __init__(self, database: Database, rate: Rate) -> None:
        """Args: database: of the service. rate: limit of each key over all processes."""
        self._database, self._rate = database, rate
        self._process = secrets.token_hex(16)
        self._held: dict[str, tuple[int, float]] = {}  # tokens, and until when they may be used
        self._refused: dict[str, float] = {}  # until when
        self._asked: dict[str, list[asyncio.Future[float]]] = {}
        self._away_until = 0.0
        self._task: asyncio.Task[None] | None = None

    def require(self, key: str) -> None:
        """Take nothing, and ask nobody.

        Raises:
            ApiError: the bucket of the key was empty when it was last asked for, and has no token yet.
        """
        if (left := self._refused.get(key, 0.0) - time.monotonic()) > 0:
            self._refuse(left)

    async def take(self, key: str) -> None:
        """Take a token of a key.

        Raises:
            ApiError: its bucket is empty.
        """
        now = time.monotonic()
        tokens, until = self._held.get(key, (0, 0.0))
        if tokens and now < until:
            self._held[key] = tokens - 1, until
            return
        self.require(key)
        if now < self._away_until:
            return
        answer: asyncio.Future[float] = asyncio.get_running_loop().create_future()  # seconds to wait; 0: it has a token
        self._asked.setdefault(key, []).append(answer)
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._run())
        try:
            wait_s = await asyncio.wait_for(answer, PATIENCE_S)
        except TimeoutError:
            return
        if wait_s > 0:
            self._refuse(wait_s)

    def _refuse(self, wait_s: float) -> NoReturn:
        raise ApiError("too-many", f"the key asks more than {self._rate.per_second:g} times a second",
                       headers={"Retry-After": str(math.ceil(wait_s))})

    async def _run(self) -> None:
        """Ask for leases until nobody waits for one."""
        while self._asked:
            asked, self._asked = self._asked, {}
            began = time.monotonic()
            wanted = [Wanted(key, len(answers), self._held.pop(key, (0, 0.0))[0]) for key, answers in asked.items()]
            try:
                given = await asyncio.to_thread(rates.lease, self._database, self._process, wanted, self._rate)
            except Exception as error:
                self._away_until = time.monotonic() + AWAY_S
                if isinstance(error, UNANSWERED):
                    logger.warning("database does not answer: each process counts requests by itself", error=message_of(error))
                else:
                    logger.error("counting requests failed: each process counts by itself", exc_info=error)
                given = [Leased(each.waiting, 0.0) for each in wanted]
            for (key, answers), leased in zip(asked.items(), given, strict=True):
                self._tell(key, answers, leased, began)
        if len(self._held) + len(self._refused) > FORGET_ABOVE:
            now = time.monotonic()
            self._held = {key: held for key, held in self._held.items() if held[1] > now}
            self._refused = {key: until for key, until in self._refused.items() if until > now}

    def _tell(self, key: str, answers: "list[asyncio.Future[float]]", leased: Leased, began: float) -> None:
        for number, answer in enumerate(answers):
            if not answer.done():  # else who asked has gone, or gone on
                answer.set_result(0.0 if number < leased.tokens else leased.wait_s)
        if leased.tokens < len(answers):
            self._refused[key] = time.monotonic() + leased.wait_s
        elif leased.tokens > len(answers):
            self._held[key] = leased.tokens - len(answers), began + LEASE_S
