"""Each kind of database, and a service without processes on it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.server.base.settings import Settings
from service.server.database.engine import Database, connect
from tests.service.server.prepared import new_on, prepare
from tests.service.server.process.house import DAYS, House


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest) -> str | None:
    """The address of a database of each kind, on PostgreSQL of a new one each time with all tables; None for SQLite."""
    return None if request.param == "sqlite" else new_on(request.getfixturevalue("server_postgres"))


@pytest.fixture
def database(tmp_path: Path, database_url: str | None) -> Iterator[Database]:
    """A database of each kind, with its tables, and as many connections as threads ask at once."""
    settings = Settings(data=tmp_path, database_url=database_url)
    made = connect(settings.sqlalchemy_url, connections=12)
    prepare(settings, made)
    yield made
    made.close()


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.long)])
def house(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[House]:
    url = None if request.param == "sqlite" else new_on(request.getfixturevalue("server_postgres"))
    made = House(tmp_path / "data", retention_days=DAYS, upload_hours=48, database_url=url)
    yield made
    made.database.close()
