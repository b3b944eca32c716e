"""The log: what anybody can cause is bounded and counted, and nobody writes to the terminal of who reads it; and which names are safe."""

import json
import logging
import os
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.server.base import log
from service.server.base.safe_names import DEVICES, MAX_DEPTH, MAX_PART_BYTES, NameFault, check_path, folded, folders_of, shown


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


PLAIN = st.characters(categories=("L", "N"), include_characters="-_+,;=@#$%&'()[]{}~! .")


def is_good(part: str) -> bool:
    """What the rules leave, said another way than the module does."""
    return (part.strip(" ") == part and part[0] != "." and part[-1] != "." and unicodedata.is_normalized("NFC", part)
            and len(part.encode()) <= 90 and part.split(".")[0].strip().casefold() not in DEVICES)


texts = st.text(PLAIN, min_size=1, max_size=30).map(lambda text: unicodedata.normalize("NFC", text))
parts = texts.filter(lambda part: part != "" and is_good(part))
paths = st.lists(parts, min_size=1, max_size=MAX_DEPTH).map("/".join)


@given(paths)
def test_a_good_path_stays_below_its_folder_and_is_the_same_in_every_case_and_form(path):
    check_path(path)
    assert os.path.normpath(os.path.join("/folder", path)) == f"/folder/{path}"
    assert folders_of(path) == [path[:at] for at, character in enumerate(path) if character == "/"]
    for other in (path.upper(), path.lower(), path.swapcase()):
        if other.casefold() == path.casefold():
            assert folded(other) == folded(path)
    assert folded(unicodedata.normalize("NFD", path)) == folded(path)
    assert folded(path).count("/") == path.count("/")
    assert len(folded(path).encode()) <= 3 * len(path.encode())


@given(paths, st.sampled_from([
    "..", ".", "", ".hidden", "con", "NUL.exr", "com1", "LPT9.txt", "end.", "end ", " begin", "a\\b", "C:", "c:\\x", "a:b", "a*", "a?", "<",
    "|", '"',
    "nul\0byte", "new\nline", "tab\t", "bell\x07", "del\x7f", "c1\x85", "right\u202eleft", "zero\u200bwidth", "join\u200d", "bom\ufeff",
    "soft\u00adhyphen", "tag\U000e0041", "line\u2028", "half\ud800", "none\u0378", "e\u0301", "x" * (MAX_PART_BYTES + 1), "ü" * 128]),
    st.data())
def test_a_bad_part_anywhere_is_refused(path, bad, data):
    names = path.split("/")[: MAX_DEPTH - 1]
    at = data.draw(st.integers(0, len(names)))
    with pytest.raises(NameFault) as refused:
        check_path("/".join([*names[:at], bad, *names[at:]]))
    sentence = str(refused.value)
    assert sentence.startswith("path ") and sentence.isprintable() and len(sentence.splitlines()) == 1


@pytest.mark.long
@given(st.text())
def test_whatever_is_let_through_is_one_file_below_the_folder(path):
    try:
        check_path(path)
    except NameFault as fault:
        assert str(fault).isprintable()
        return
    assert os.path.normpath(f"/folder/{path}") == f"/folder/{path}"
    assert all(part and not part.startswith(".") for part in path.split("/"))
    assert path.encode().decode() == unicodedata.normalize("NFC", path)


@pytest.mark.parametrize(("path", "reason"), [
    ("", "empty"), ("/etc/passwd", "absolute"), ("../x", "begins with a dot|leads out"), ("a/../b", "leads out"), ("C:/x", ":"),
    ("a\\b", "\\"), ("a\0b", "U+0000"), ("a\u202eb", "U+202E"), ("e\u0301", "NFC"), ("a//b", "empty name"), ("a/", "empty name"),
    (".git/x", "dot"), ("aux", "device"), ("a/NUL.tar.gz", "device"), ("x ", "ends with"), ("x.", "ends with"),
    ("a/" * MAX_DEPTH + "x", "deep"), ("x" * 256, "255 bytes"), ("/".join(["x" * 200] * 5), "800 bytes")])
def test_the_reason_is_named(path, reason):
    with pytest.raises(NameFault) as refused:
        check_path(path)
    assert any(word in str(refused.value) for word in reason.split("|"))


@pytest.mark.long
def test_a_name_is_shown_so_that_it_does_no_harm():
    assert shown("plain näme.exr") == '"plain näme.exr"'
    assert shown("a\nb\u202ec\0") == '"a\\nb\\u202ec\\x00"'
    assert len(shown("x" * 5000)) < 120
