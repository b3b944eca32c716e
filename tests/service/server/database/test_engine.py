"""Connections of the database."""

from service.server.database.engine import connect


def test_all_connections_can_be_opened_at_once_and_are_kept(tmp_path):
    database = connect(f"sqlite:///{tmp_path / 'relit.sqlite'}", connections=3)
    database.open_connections()
    assert database.engine.pool.checkedin() == 3 and database.engine.pool.checkedout() == 0
    database.check()
    assert database.engine.pool.checkedin() == 3
    database.close()
