"""Names of uploaded files: good ones come through as they are, bad ones are refused with the reason."""

import os
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.server.base.safe_names import DEVICES, MAX_DEPTH, MAX_PART_BYTES, NameFault, check_path, folded, folders_of, shown

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
