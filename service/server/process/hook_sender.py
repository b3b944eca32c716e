"""Deliveries to hooks: sent by `relit serve`, apart from jobs and workers, signed as Standard Webhooks 1.0 says.

A delivery that is not accepted with a status 2xx is tried again after 5 s, 20 s, 80 s and so on, four times as long each time, at most six
hours, and up to a tenth more by chance. After MOST_TRIES tries, within two days, it is given up. Each try has the same `webhook-id`.
"""

import base64
import hashlib
import hmac
import json
import random
import threading
import time
import traceback
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial

import sqlalchemy as sa

from service import __version__
from service.server.api.views import job_view
from service.server.base import outgoing
from service.server.base.log import logger
from service.server.base.settings import Settings
from service.server.database import hooks, jobs
from service.server.database.engine import UNANSWERED, Database, message_of

EVERY_S = 1.0
"""Seconds between two looks for deliveries that are due."""
FIRST_PAUSE_S, LONGEST_PAUSE_S, MOST_TRIES = 5.0, 21_600.0, 14
AT_ONCE, OF_PROJECT = 32, 4
"""Requests that are under way at most, in all and of one project; of one hook there is one, so that a slow receiver holds no other."""
PATIENCE_S = 20.0
"""Seconds for which the result of a try waits for a database that does not answer; then the try counts as lost."""
CLOSE_S = 1.0
"""Seconds that the requests under way get when the service ends; another try follows when it runs again."""


class HookSender:
    """Sends deliveries that are due, in threads; several services with one database share the work."""

    def __init__(self, settings: Settings, database: Database, *, clock: Callable[[], float] = time.time) -> None:
        self._networks, self._database, self._clock = settings.hook_networks, database, clock
        self._busy: dict[str, tuple[str, threading.Thread]] = {}  # project and thread, by hook
        self._lock = threading.Lock()
        self._told = ""  # the last error, which is logged once
        self._wake, self._ended = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="relit-hooks", daemon=True)

    def start(self) -> None:
        """Start the thread that looks for deliveries."""
        self._thread.start()

    def stop(self) -> None:
        """Begin no further try, and wait a moment for those under way."""
        self._ended = True
        self._wake.set()
        self._thread.join()
        self.wait(CLOSE_S)

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until no request is under way, or until the time is over."""
        with self._lock:
            threads = [thread for _, thread in self._busy.values()]
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        for thread in threads:
            thread.join(None if deadline is None else max(0.0, deadline - time.monotonic()))

    def round(self) -> None:
        """Begin a try of what is due, of each hook one."""
        for row in hooks.due(self._database, self._clock()):
            with self._lock:
                of_project = sum(project == row["project"] for project, _ in self._busy.values())
                if row["hook"] in self._busy or of_project >= OF_PROJECT or len(self._busy) >= AT_ONCE:
                    continue
            taken = self._database.transact(partial(hooks.take, delivery=row["id"], now=self._clock()))
            if taken is not None:
                thread = threading.Thread(target=self._try, args=(taken,), name=f"relit-{taken['id']}", daemon=True)
                with self._lock:
                    self._busy[row["hook"]] = row["project"], thread
                thread.start()

    def _run(self) -> None:
        while not self._ended:
            try:
                self.round()
                self._told = ""
            except Exception as error:  # of the database, which may answer later, or of relit itself
                if (told := message_of(error)) != self._told:
                    known = isinstance(error, UNANSWERED)
                    logger.warning("hooks wait", error=told, **({} if known else {"trace": traceback.format_exc()}))
                self._told = told
            self._wake.wait(EVERY_S)
            self._wake.clear()

    def _try(self, taken: sa.RowMapping) -> None:
        try:
            body, now = body_of(taken), int(self._clock())
            answer = outgoing.post(taken["url"], body, headers_of(taken["secret"], taken["id"], now, body), self._networks)
            self._database.transact(lambda connection: self._record(connection, taken, answer), patience_s=PATIENCE_S)
        except Exception as error:  # the delivery is tried again when its lease has ended
            logger.error("delivery failed", delivery=taken["id"], error=message_of(error), trace=traceback.format_exc())
        finally:
            with self._lock:
                del self._busy[taken["hook"]]
            self._wake.set()

    def _record(self, connection: sa.Connection, taken: sa.RowMapping, answer: outgoing.Answer) -> None:
        """Record an answer with the delivery, and in the log of the job the first refusal and the end."""
        tries, words, due_at = taken["tries"], answer.words, None
        state = hooks.DELIVERED if answer.accepted else hooks.GIVEN_UP if tries >= MOST_TRIES else hooks.WAITING
        if state == hooks.WAITING:
            due_at = self._clock() + min(FIRST_PAUSE_S * 4 ** (tries - 1), LONGEST_PAUSE_S) * random.uniform(1.0, 1.1)
        if not hooks.settle(connection, taken, state=state, answer=words, due_at=due_at) or (state == hooks.WAITING and tries > 1):
            return
        said = {hooks.DELIVERED: "told", hooks.GIVEN_UP: f"given up after {tries} tries", hooks.WAITING: "not told, tried again"}[state]
        logger.info("hook delivery", delivery=taken["id"], hook=taken["hook"], job=taken["job"], state=state, answer=words)
        if taken["job"] is not None:
            jobs.note(connection, taken["job"], f"{taken['hook']} {said}: {words}")


def body_of(delivery: sa.RowMapping) -> bytes:
    """Return the body of a delivery, the same in each try: the type of the event, its time, and the job as it was then."""
    data = {"hook": delivery["hook"]} if delivery["snapshot"] is None else job_view(delivery["snapshot"]).model_dump(mode="json")
    kind = "hook.test" if delivery["snapshot"] is None else f"job.{delivery['event']}"
    at = datetime.fromtimestamp(delivery["made_at"], UTC).isoformat().replace("+00:00", "Z")
    return json.dumps({"type": kind, "timestamp": at, "data": data}, separators=(",", ":")).encode()


def headers_of(secret: str, identifier: str, now: int, body: bytes) -> dict[str, str]:
    """Return the headers of a try, with the signature of its identifier, time and body."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signature = hmac.digest(key, b".".join((identifier.encode(), str(now).encode(), body)), hashlib.sha256)
    return {"Content-Type": "application/json", "User-Agent": f"relit/{__version__}", "webhook-id": identifier,
            "webhook-timestamp": str(now), "webhook-signature": f"v1,{base64.b64encode(signature).decode()}"}
