"""relit doctor, of a service."""

import sqlite3

import pytest

from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import CheckJob
from service.server.base.settings import Settings
from service.server.database import keys, workers
from service.server.database.schema import REVISIONS
from service.server.jobs.queue import JobQueue
from tests.service.server.prepared import opened
from tests.service.server_process import new_key, revoke


@pytest.fixture
def data(tmp_path, monkeypatch):
    monkeypatch.setenv("RELIT_MIN_FREE_BYTES", "0")
    return tmp_path / "data"


@pytest.fixture(autouse=True)
def database(data):
    """The database of a service with one key."""
    with opened(Settings(data=data)) as made:
        new_key(made)
        yield made


def lines_of(outcome) -> dict[str, str]:
    """By their first word; the last of each."""
    return {line.split(maxsplit=1)[0]: line.split(maxsplit=1)[1] for line in outcome.out.splitlines() if " " in line}


def test_a_sound_service(relit, data, database, tmp_path, monkeypatch):
    workers.insert(database, "w1", host="h", pid=1, device="cuda:1")
    (tmp_path / "captures").mkdir()
    monkeypatch.setenv("RELIT_PROJECT_ROOTS", f"larch={tmp_path / 'captures'}")
    outcome = relit.done("doctor", "--device", "cpu", "--data", data)
    lines = lines_of(outcome)
    assert "dbos" in lines["service"] and "fastapi" in lines["service"]
    assert lines["storage"] == f"{data} can be written" and lines["database"] == f"{data / 'relit.sqlite'} answers"
    assert lines["keys"] == "1, of 1 projects" and lines["worker"] == "w1 on cuda:1, ready"
    assert lines["root"] == f"{tmp_path / 'captures'} of larch can be read"
    assert "GiB free" in lines["space"] and lines["jobs"] == "none"
    assert outcome.out.splitlines()[-1] == "sound"


@pytest.mark.parametrize("command", [["doctor", "--device", "cpu"], ["serve", "--port", "0"], ["worker", "--device", "cpu"]], ids="-".join)
def test_a_data_folder_below_a_root_is_refused(relit, data, monkeypatch, command):
    monkeypatch.setenv("RELIT_ROOTS", str(data.parent))
    relit(*command, "--data", data).refused("could register the captures of another", printed="doctor" in command)


def test_the_folder_that_is_here_is_looked_at_and_none_is_made(relit, data, tmp_path, monkeypatch):
    (tmp_path / "new").mkdir()
    monkeypatch.chdir(tmp_path / "new")
    assert "database" not in relit("doctor", "--device", "cpu").well()  # nothing is asked of a service that is not there
    assert "is not there yet" in lines_of(relit("doctor", "--device", "cpu", "--data", tmp_path / "new"))["database"]
    assert list((tmp_path / "new").iterdir()) == []
    data.rename(tmp_path / "new" / "relit-data")
    assert "database" in lines_of(relit("doctor", "--device", "cpu"))


def wrong(relit, *arguments: object) -> list[str]:
    """What is wrong."""
    outcome = relit("doctor", "--device", "cpu", *arguments)
    assert (outcome.code, outcome.err) == (1, "")
    return [line.split(maxsplit=1)[1] for line in outcome.out.splitlines() if line.startswith("wrong ")]


def test_no_key_and_jobs_that_wait_for_nobody(relit, data, database, monkeypatch):
    revoke(database, keys.listing(database)[0]["id"])
    (line,) = wrong(relit, "--data", data)
    assert line.startswith("keys: none") and "relit keys create" in line
    monkeypatch.setenv("RELIT_ANONYMOUS", "true")
    assert relit("doctor", "--device", "cpu", "--data", data).code == 0
    queue = JobQueue(database)
    database.transact(lambda connection: queue.submit(
        connection, project="larch", request=CheckJob(kind="check", intake=new_id(CAPTURE))))
    (line,) = wrong(relit, "--data", data)
    assert line.startswith("worker: none") and "1 jobs wait" in line


def test_a_database_of_another_version_or_of_something_else(relit, data, database):
    database.transact(lambda connection: connection.exec_driver_sql(f"UPDATE {REVISIONS} SET version_num = '99'"))
    assert wrong(relit, "--data", data)[0].startswith("database: the database has the tables of a newer relit")
    (data / "relit.sqlite").unlink()
    with sqlite3.connect(data / "relit.sqlite") as other:
        other.execute("CREATE TABLE cats (name TEXT)")
    (line,) = wrong(relit, "--data", data)
    assert line.startswith("database: the database has no tables of relit")
    (data / "relit.sqlite").write_bytes(b"no database" * 1000)
    assert wrong(relit, "--data", data)[0].startswith("database: does not answer: ")


def test_a_database_server_that_is_not_there_folders_and_variables(relit, data, monkeypatch, tmp_path):
    monkeypatch.setenv("RELIT_DATABASE_URL", "postgresql://u:secret@127.0.0.1:1/relit")
    found = wrong(relit, "--data", data)
    assert len(found) == 1 and found[0].startswith("database: does not answer: ") and "secret" not in found[0]
    monkeypatch.setenv("RELIT_DATABASE_URL", "mysql://u@h/x")
    assert "mysql is not supported" in wrong(relit, "--data", data)[0]
    monkeypatch.delenv("RELIT_DATABASE_URL")
    monkeypatch.setenv("RELIT_ROOTS", str(tmp_path / "gone"))
    monkeypatch.setenv("RELIT_PROT", "1")
    monkeypatch.setenv("RELIT_MIN_FREE_BYTES", str(10**18))
    found = wrong(relit, "--data", data)
    assert [line.partition(":")[0] for line in found] == ["settings", "space", "root"]
    assert "is RELIT_PORT meant?" in found[0] and "less than min_free_bytes" in found[1]
    monkeypatch.setenv("RELIT_DATA", str(tmp_path / "nowhere"))
    assert f"data: {tmp_path / 'nowhere2'} is no folder" in wrong(relit, "--data", tmp_path / "nowhere2")
