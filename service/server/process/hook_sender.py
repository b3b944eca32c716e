"""Deliveries to hooks: sent by `relit serve`, apart from jobs and workers, signed as Standard Webhooks 1.0 says.

After a delivery that is not accepted with a status 2xx, its hook pauses for 5 s, then 20 s, 80 s and so on, four times as long each time,
at most six hours, and up to a tenth more by chance; one that is accepted ends this. A delivery is given up after MOST_TRIES tries, and by
the housekeeping after two days. Each try has the same `webhook-id` and body.
"""

import base64
import hashlib
import hmac
import random
import threading
import time
import traceback
from collections.abc import Callable

import sqlalchemy as sa

from service import __version__
from service.server.base import outgoing
from service.server.base.log import logger
from service.server.base.rounds import Rounds
from service.server.base.settings import Settings
from service.server.database import hooks, jobs
from service.server.database.engine import UNANSWERED, Database, message_of

EVERY_S = 1.0
"""Seconds between two looks for deliveries that are due."""
FIRST_PAUSE_S, LONGEST_PAUSE_S, MOST_TRIES = 5.0, 21_600.0, 14
AT_ONCE, OF_PROJECT = 32, 4
"""Requests that are under way at most, in all and of one project; of one hook there is one. Hooks take turns, so that a slow receiver
delays another by the time of one request, not by all that waits for it."""
PATIENCE_S = 20.0
"""Seconds for which the result of a try waits for a database that does not answer; then the try counts as lost."""
LEASE_S = outgoing.TIMEOUT_S + PATIENCE_S + 30.0
"""Seconds after which another sender takes a hook: a try and its record take less, with the wait for a connection to the database."""
CLOSE_S = 1.0
"""Seconds that the requests under way get when the service ends; another try follows when it runs again."""


class HookSender(Rounds):
    """Sends deliveries that are due, in threads; several services with one database share the work."""

    def __init__(self, settings: Settings, database: Database, *, clock: Callable[[], float] = time.time) -> None:
        super().__init__("relit-hooks", EVERY_S, self._guarded_round)
        self._networks, self._database, self._clock = settings.hook_networks, database, clock
        self._busy: dict[str, tuple[str, threading.Thread]] = {}  # project and thread, by hook
        self._lock = threading.Lock()
        self._told = ""  # the last error, which is logged once

    def stop(self) -> None:
        """Begin no further try, and wait a moment for those under way."""
        super().stop()
        self.wait(CLOSE_S)

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until no request is under way, or until the time is over."""
        with self._lock:
            threads = [thread for _, thread in self._busy.values()]
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        for thread in threads:
            thread.join(None if deadline is None else max(0.0, deadline - time.monotonic()))

    def round(self) -> None:
        """Begin a try of one delivery to each hook that is due, those first that have been free for longest."""
        for row in hooks.due(self._database, self._clock()):
            with self._lock:
                of_project = sum(project == row["project"] for project, _ in self._busy.values())
                if row["id"] in self._busy or of_project >= OF_PROJECT or len(self._busy) >= AT_ONCE:
                    continue
            now = self._clock()
            with self._database.begin() as connection:
                taken = hooks.take(connection, row["id"], now=now, until=now + LEASE_S)
            if taken is not None:
                thread = threading.Thread(target=self._try, args=(taken,), name=f"relit-{taken['id']}", daemon=True)
                with self._lock:  # for which the thread waits at its end
                    thread.start()
                    self._busy[row["id"]] = row["project"], thread

    def _guarded_round(self) -> None:
        try:
            self.round()
            self._told = ""
        except Exception as error:  # of the database, which may answer later, or of relit itself
            if (told := message_of(error)) != self._told:
                known = isinstance(error, UNANSWERED)
                logger.warning("hooks wait", error=told, **({} if known else {"trace": traceback.format_exc()}))
            self._told = told

    def _try(self, taken: sa.RowMapping) -> None:
        try:
            answer = self._answer(taken)
            self._database.transact(lambda connection: self._record(connection, taken, answer), patience_s=PATIENCE_S)
        except Exception as error:  # of the database: the delivery is tried again when LEASE_S have passed
            logger.error("delivery not recorded", delivery=taken["id"], error=message_of(error), trace=traceback.format_exc())
        finally:
            with self._lock:
                del self._busy[taken["hook"]]
            self._wake.set()

    def _answer(self, taken: sa.RowMapping) -> outgoing.Answer:
        body = taken["body"].encode()
        try:
            return outgoing.post(taken["url"], body, headers_of(taken["secret"], taken["id"], int(self._clock()), body), self._networks)
        except Exception as error:  # of relit itself: it counts as a refusal, so that it ends
            logger.error("delivery failed", delivery=taken["id"], error=message_of(error), trace=traceback.format_exc())
            return outgoing.Answer(False, "it could not be sent: the log of the service says why")

    def _record(self, connection: sa.Connection, taken: sa.RowMapping, answer: outgoing.Answer) -> None:
        """Record an answer with the delivery, and in the log of the job the first refusal and the end."""
        tries, words, due_at = taken["tries"], answer.words, self._clock()
        state = hooks.DELIVERED if answer.accepted else hooks.GIVEN_UP if tries >= MOST_TRIES else hooks.WAITING
        if not answer.accepted:
            due_at += min(FIRST_PAUSE_S * 4 ** min(taken["failures"], MOST_TRIES), LONGEST_PAUSE_S) * random.uniform(1.0, 1.1)
        if not hooks.settle(connection, taken, state=state, answer=words, due_at=due_at) or (state == hooks.WAITING and tries > 1):
            return
        said = {hooks.DELIVERED: "told", hooks.GIVEN_UP: f"given up after {tries} tries", hooks.WAITING: "not told, tried again"}[state]
        logger.info("hook delivery", delivery=taken["id"], hook=taken["hook"], job=taken["job"], state=state, answer=words)
        if taken["job"] is not None:
            jobs.note(connection, taken["job"], f"{taken['hook']} {said}: {words}")


def headers_of(secret: str, identifier: str, now: int, body: bytes) -> dict[str, str]:
    """Return the headers of a try, with the signature of its identifier, time and body."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signature = hmac.digest(key, b".".join((identifier.encode(), str(now).encode(), body)), hashlib.sha256)
    return {"Content-Type": "application/json", "User-Agent": f"relit/{__version__}", "webhook-id": identifier,
            "webhook-timestamp": str(now), "webhook-signature": f"v1,{base64.b64encode(signature).decode()}"}
