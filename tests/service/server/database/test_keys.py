"""relit keys."""

import getpass
import sqlite3
import time

import pytest

from service.requests.keys import Scope
from service.server.base.settings import Settings
from service.server.database import engine, keys, tables
from tests.service.server.prepared import opened


@pytest.fixture
def data(tmp_path):
    return tmp_path / "data"


@pytest.fixture
def database(data):
    """The database for the keys that a test makes."""
    with opened(Settings(data=data)) as made:
        yield made


@pytest.fixture
def made(relit, data):
    """Make a key; the key."""
    def make(project="larch", name="Ann B.", scope="write"):
        outcome = relit("keys", "create", "--data", data, "--project", project, "--name", name, "--scope", scope)
        assert (outcome.code, outcome.err) == (0, "keep it: it is not shown again\n")
        return outcome.out.removesuffix("\n")

    return make


def test_a_key_is_printed_alone_and_opens_its_project(made, data, database):
    key = made()
    assert keys.find(database, key) == keys.Caller("larch", Scope.WRITE, key.partition(".")[0], None)


def test_keys_are_listed_without_their_secrets(relit, made, data):
    first, second = made(), made("willow", "render farm", "read")
    out = relit("keys", "list", "--data", data).well()
    lines = out.splitlines()
    assert len(lines) == 3 and [line.split()[0] for line in lines[1:]] == [key.partition(".")[0] for key in (first, second)]
    assert all(word in lines[2] for word in ("willow", "read", "render farm"))
    assert not any(key.partition(".")[2] in out for key in (first, second))
    assert len(relit("keys", "list", "--data", data, "--project", "willow").out.splitlines()) == 2


def test_a_key_expires(relit, data, database):
    key = relit("keys", "create", "--data", data, "--project", "larch", "--name", "x", "--scope", "read", "--expires-days", "2").out.strip()
    until = keys.listing(database)[0]["expires_at"]
    assert until == pytest.approx(time.time() + 2 * 86_400, abs=600)  # the time that this test takes
    caller = keys.find(database, key)
    assert caller.until == until and not keys.no_longer_valid(database, [caller])
    database.transact(lambda connection: connection.execute(tables.keys.update().values(expires_at=time.time() - 1)))
    assert "expired" in keys.find(database, key) and keys.no_longer_valid(database, [caller]) == {caller}


def test_the_last_use_of_a_key_is_recorded_to_a_minute(relit, made, data, database):
    key = made()
    assert keys.find(database, f"{key}x") == "this service does not know the key"
    assert keys.listing(database)[0]["used_at"] is None
    assert isinstance(keys.find(database, key), keys.Caller)
    first = keys.listing(database)[0]["used_at"]
    assert first == pytest.approx(time.time(), abs=600)
    assert keys.find(database, key) and keys.listing(database)[0]["used_at"] == first
    database.transact(lambda connection: connection.execute(tables.keys.update().values(used_at=first - 2 * keys.USED_S)))
    assert keys.find(database, key) and keys.listing(database)[0]["used_at"] >= first


def test_making_and_revoking_keys_is_audited(relit, made, data):
    identifier = made().partition(".")[0]
    relit("keys", "revoke", identifier, "--data", data)
    lines = relit("audit", "--data", data).out.splitlines()
    assert [line.split()[3:] for line in lines[1:]] == [["operator", getpass.getuser(), "key.revoke", identifier],
                                                       ["operator", getpass.getuser(), "key.create", identifier]]
    assert len(relit("audit", "--data", data, "--project", "willow").out.splitlines()) == 1


def test_a_database_that_cannot_be_written_is_one_sentence(relit, made, data, monkeypatch):
    identifier = made().partition(".")[0]
    monkeypatch.setattr(engine, "BUSY_MS", 1)
    holder = sqlite3.connect(data / "relit.sqlite", isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")  # root may write a read-only file, so another keeps it from being written
    for arguments in (["create", "--project", "larch", "--name", "x", "--scope", "read"], ["revoke", identifier]):
        outcome = relit("keys", *arguments, "--data", data)
        assert (outcome.code, outcome.out) == (2, "")
        assert outcome.err == f"relit: data {data}: the database in it cannot be used (database is locked)\n"
    holder.close()
    (data / "relit.sqlite").write_bytes(b"no database" * 1000)
    relit("keys", "list", "--data", data).refused("the database in it cannot be used")


def test_a_key_is_revoked_once(relit, made, data, database):
    identifier = made().partition(".")[0]
    assert relit("keys", "revoke", identifier, "--data", data) == (0, f"revoked  {identifier}\n", "")
    again = relit("keys", "revoke", identifier, "--data", data)
    assert again.code == 2 and again.err == f"relit: {identifier}: there is no such key that is not revoked\n"
    assert [row["revoked_at"] is not None for row in keys.listing(database)] == [True]
    key = made()  # who has only the key revokes with it; its secret is not shown again
    assert key.partition(".")[2] not in relit("keys", "revoke", key, "--data", data).well()


@pytest.mark.parametrize(("arguments", "words"), [
    (["create", "--project", "My Owls", "--name", "x", "--scope", "read"], 'project: is "My Owls": give 1 to 63 of a-z, 0-9 and -'),
    (["create", "--project", "../x", "--name", "x", "--scope", "read"], "project"),
    (["create", "--project", "larch", "--name", "", "--scope", "read"], "name"),
    (["create", "--project", "larch", "--name", "a\nb", "--scope", "read"], "name"),
    (["create", "--project", "larch", "--name", "x", "--scope", "root"], "'root' is not one of 'read', 'write', 'admin'"),
    (["create", "--project", "larch", "--name", "x"], "--scope"),
    (["list"], "there is no service in this folder"),
    (["revoke", "key_x"], "there is no service in this folder"),
])
def test_what_cannot_be_is_one_sentence_and_makes_nothing(relit, data, arguments, words):
    relit("keys", *arguments, "--data", data).refused(words)
    assert not data.exists()
