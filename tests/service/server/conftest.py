"""A service without processes, on each kind of database."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.server.house import DAYS, House


@pytest.fixture(params=["sqlite", "postgresql"])
def house(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[House]:
    url = None if request.param == "sqlite" else request.getfixturevalue("server_postgres").new_database()
    made = House(tmp_path / "data", retention_days=DAYS, upload_hours=48, database_url=url)
    yield made
    made.database.close()
