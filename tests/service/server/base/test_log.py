"""The log: what anybody can cause is bounded and counted, and nobody writes to the terminal of who reads it."""

import json
import logging

import pytest

from service.server.base import log


@pytest.fixture(autouse=True)
def own_log(monkeypatch):
    """The test configures the log; what was configured before is put back afterwards."""
    root = logging.getLogger()
    before = root.handlers[:]
    yield
    root.handlers[:] = before


def lines(capfd) -> list[dict]:
    return [json.loads(line) for line in capfd.readouterr().err.splitlines()]


def test_warnings_that_repeat_are_counted(capfd, monkeypatch):
    log.configure("info", "json")
    for number in range(100):
        log.logger.warning("too many", number=number)
        logging.getLogger("asyncio").error("socket.accept() out of system resource")
    log.logger.warning("another")
    found = lines(capfd)
    assert [line["number"] for line in found if line["event"] == "too many"] == list(range(log.REPEATS))
    assert sum("accept" in line["event"] for line in found) == log.REPEATS
    assert sum(line["event"] == "another" for line in found) == 1
    monkeypatch.setattr(log, "EVERY_S", -1.0)  # a minute later
    now = log.time.monotonic()
    monkeypatch.setattr(log.time, "monotonic", lambda: now + 2)
    log.logger.info("later")
    told = {line["what"]: line["more"] for line in lines(capfd) if line["event"] == "repeated"}
    assert told == {"relit too many": 100 - log.REPEATS, "asyncio socket.accept() out of system resource": 100 - log.REPEATS}


def test_refused_requests_of_one_client_are_counted_and_others_are_all_written(capfd):
    log.configure("info", "json")
    for number in range(50):
        for status, client in ((429, "10.0.0.1"), (401, "10.0.0.2"), (422, "10.0.0.1"), (200, "10.0.0.1")):
            log.logger.info("request", status=status, client=client, number=number)
    log.logger.info("request", status=429, client="10.0.0.9")
    found = lines(capfd)
    assert [sum((line["status"], line["client"]) == one for line in found)
            for one in ((429, "10.0.0.1"), (401, "10.0.0.2"), (422, "10.0.0.1"), (200, "10.0.0.1"), (429, "10.0.0.9"))] == [
        log.REPEATS, log.REPEATS, 50, 50, 1]


def test_kinds_are_bounded(capfd):
    log.configure("info", "json")
    for number in range(log.MAX_KINDS + 500):
        log.logger.info("request", status=401, client=f"fd00::{number:x}")
    assert len(lines(capfd)) <= log.MAX_KINDS + log.REPEATS


@pytest.mark.parametrize("form", ["text", "json"])
def test_control_characters_are_escaped(capfd, form):
    log.configure("info", form)
    evil = "\x1b[2J\x9b\r\nforged [info] line\x07\u202e\ud800"
    log.logger.info("request", path=evil, problem=f"path {evil}")
    logging.getLogger("uvicorn.error").warning("bad %s", evil)
    try:
        raise ValueError(evil)
    except ValueError as error:
        log.logger.error("failed", exc_info=error)
    written = capfd.readouterr().err
    assert all(letter.isprintable() or letter == "\n" for letter in written)
    assert "\\x1b[2J" in written if form == "text" else "\\u001b[2J" in written
    if form == "text":
        assert sum("forged" in line for line in written.splitlines() if not line.startswith(" ")) >= 3
        assert not written.splitlines()[1].startswith("forged")
