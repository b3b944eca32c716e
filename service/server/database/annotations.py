"""Annotations of captures, which go with them."""

import time

import sqlalchemy as sa

from service.requests.base.identifiers import ANNOTATION, new_id
from service.server.database.engine import Database
from service.server.database.tables import annotations, intakes

MOST = 500
"""Annotations of one capture."""


def listing(database: Database, capture: str) -> list[sa.RowMapping]:
    """Return the annotations of a capture, the oldest first."""
    of_capture = sa.select(annotations).where(annotations.c.intake == capture)
    return database.rows(of_capture.order_by(annotations.c.created_at, annotations.c.id))


def insert(connection: sa.Connection, capture: str, content: dict[str, object]) -> sa.RowMapping | None:
    """Insert an annotation, and return its row; None: the capture has MOST already, or is gone."""
    connection.execute(intakes.update().where(intakes.c.id == capture).values(name=intakes.c.name))  # locks the row: the count stays
    is_there = connection.execute(sa.select(intakes.c.id).where(intakes.c.id == capture)).first() is not None
    count = connection.execute(sa.select(sa.func.count()).where(annotations.c.intake == capture)).scalar() or 0
    if not is_there or count >= MOST:
        return None
    identifier = new_id(ANNOTATION)
    connection.execute(annotations.insert().values(id=identifier, intake=capture, content=content, created_at=time.time()))
    return connection.execute(sa.select(annotations).where(annotations.c.id == identifier)).mappings().one()


def remove(connection: sa.Connection, capture: str, identifier: str) -> bool:
    """Delete an annotation of a capture; return False if there is none."""
    return connection.execute(annotations.delete().where(annotations.c.id == identifier, annotations.c.intake == capture)).rowcount == 1
