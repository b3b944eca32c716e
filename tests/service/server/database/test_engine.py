import time

from service.server.database.engine import connect


def test_the_clock_of_sqlite_of_any_version_has_parts_of_seconds(tmp_path):
    """DBOS puts it into defaults of columns, also where SQLite is older than 3.42 and knows none."""
    database = connect(f"sqlite:///{tmp_path / 'made.sqlite'}")
    begun = time.time()
    with database.engine.begin() as connection:
        connection.exec_driver_sql("CREATE TABLE made (at REAL NOT NULL DEFAULT (unixepoch('subsec') * 1000), number INTEGER)")
        connection.exec_driver_sql("INSERT INTO made (number) VALUES (1)")
        at, = connection.exec_driver_sql("SELECT at FROM made").one()
    database.close()
    assert begun - 2e-3 <= at / 1000 <= time.time() + 2e-3  # SQLite counts milliseconds
