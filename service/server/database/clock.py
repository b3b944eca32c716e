"""Check that the machine's clock is right before something is removed for its age.

A clock that jumps years ahead would make every job old at once. So the time at each look is recorded, and compared at the next look with
the time that has really passed; after a jump, ages count again only when the clock has gone on steadily for WAIT_S.
"""

from collections.abc import Callable

import sqlalchemy as sa

from service.server.base.log import logger
from service.server.database.engine import Database
from service.server.database.tables import clock

WAIT_S = 86_400.0
"""Seconds after a jump for which nothing is removed for its age: an operator reads the log and sets the clock meanwhile."""
STEP_S = 3600.0
"""Seconds by which a clock may be set forth or back without being a jump."""
DOWNTIME_S = 86_400.0
"""Seconds for which the service may be away without its clock being doubted: how long it was really away, nobody knows."""


class ClockWatch:
    """Looks at the clock now and then, and tells whether ages by it count."""

    def __init__(self, database: Database, *, now: Callable[[], float], monotonic: Callable[[], float]) -> None:
        """Args: database: of the service. now: returns seconds since 1970. monotonic: returns seconds that never jump."""
        self._database, self._now, self._monotonic = database, now, monotonic
        self._looked: float | None = None

    def steady(self) -> bool:
        """Record the time, and return whether the clock has gone on without a jump for WAIT_S.

        Raises:
            DBAPIError: the database does not answer.
        """
        now, monotonic = self._now(), self._monotonic()
        row = self._database.row(sa.select(clock))
        passed = 0.0 if self._looked is None else monotonic - self._looked
        waits_s = 0.0 if row is None else max(0.0, row["waits_s"] - passed)
        if row is not None:
            jump = now - row["seen_at"] - passed
            if not -STEP_S <= jump <= (DOWNTIME_S if self._looked is None else STEP_S):
                logger.error("the clock jumped: for a day nothing is removed for its age", jump_s=round(jump))
                waits_s = WAIT_S
        self._database.transact(lambda connection: _record(connection, now, waits_s))
        self._looked = monotonic
        return waits_s == 0.0


def _record(connection: sa.Connection, now: float, waits_s: float) -> None:
    if connection.execute(clock.update().values(seen_at=now, waits_s=waits_s)).rowcount == 0:
        connection.execute(clock.insert().values(id=1, seen_at=now, waits_s=waits_s))
